import csv
import json
from pathlib import Path

import pytest
import yaml
from conftest import differences, state_of, without_clock

from sb3_skillgraph import SkillGraphAgent, cli, training
from sb3_skillgraph.callbacks import SkillGraphProgressBarCallback
from sb3_skillgraph.envs import _TASKS
from sb3_skillgraph.evaluation import evaluate_pairs
from sb3_skillgraph.hyperparams import FILE, load_hyperparams
from sb3_skillgraph.options.learner import OptionTD3
from sb3_skillgraph.run_folder import checkpoints, read_progress

TOY = "SkillGraph/ToyMaze-v0"


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    out = tmp_path_factory.mktemp("cli") / "toy"
    arguments = ["--steps", "600", "--seed", "3", "--n-envs", "2", "--hyperparams", "learning_starts=100", "tau=1e-2"]
    assert cli.main(["train", TOY, "--out", str(out), *arguments, "--env-kwargs", "max_steps=50"]) == 0
    return out


def error_line(capsys, argv):
    try:
        code = cli.main(argv)
    except SystemExit as error:  # argparse's own way out
        code = error.code
    captured = capsys.readouterr()
    assert code == 2
    assert captured.err.count("\n") == 1, captured.err
    assert captured.err.startswith("sb3-skillgraph")
    return captured.err


class TestTrain:
    def test_leaves_agent_log_and_configuration(self, trained):
        agent = SkillGraphAgent.load(trained / "agent.zip")
        assert agent.num_timesteps == 600
        assert agent.seed == 3 and agent.n_envs == 2 and agent.tau == 0.01
        rows = list(csv.DictReader((trained / "progress.csv").read_text().splitlines()))
        assert "skillgraph/events" in rows[-1]
        config = json.loads((trained / "config.json").read_text())
        assert config["env"] == TOY and config["seed"] == 3 and config["steps"] == 600
        assert config["env_kwargs"] == {"max_steps": 50}
        assert config["arguments"]["learning_starts"] == 100
        assert "torch" in config["versions"]

    def test_does_not_overwrite_an_agent(self, trained, capsys):
        before = (trained / "agent.zip").read_bytes()
        assert "holds an agent already" in error_line(capsys, ["train", TOY, "--out", str(trained)])
        assert (trained / "agent.zip").read_bytes() == before

    def test_interrupt_saves_the_agent(self, tmp_path, capsys, monkeypatch):
        def interrupt(self):
            if self.num_timesteps == 120:
                raise KeyboardInterrupt
            return True

        monkeypatch.setattr(SkillGraphProgressBarCallback, "_on_step", interrupt)
        assert cli.main(["train", TOY, "--steps", "500", "--out", str(tmp_path)]) == 130
        captured = capsys.readouterr()
        assert "interrupted" in captured.err and "agent.zip" in captured.out
        assert SkillGraphAgent.load(tmp_path / "agent.zip").num_timesteps == 120

    def test_an_interrupted_run_goes_on_and_comes_to_the_same(self, tmp_path, capsys, monkeypatch):
        monkeypatch.setattr(training, "CHECKPOINT_EVERY", 200)
        alone, broken = tmp_path / "alone", tmp_path / "broken"
        command = [
            "train",
            TOY,
            "--steps",
            "700",
            "--hyperparams",
            "learning_starts=100",
            "--env-kwargs",
            "max_steps=50",
            "--out",
        ]
        assert cli.main([*command, str(alone)]) == 0
        assert list(checkpoints(alone)) == []

        def interrupt(self):
            if self.num_timesteps == 530:
                raise KeyboardInterrupt
            return True

        with monkeypatch.context() as patch:
            patch.setattr(SkillGraphProgressBarCallback, "_on_step", interrupt)
            assert cli.main([*command, str(broken)]) == 130
        assert "the same command goes on after 400 steps" in capsys.readouterr().out
        assert "unfinished run with other settings" in error_line(capsys, [*command, str(broken), "--seed", "1"])
        assert cli.main([*command, str(broken)]) == 0
        assert "going on after 400 steps" in capsys.readouterr().out
        assert list(checkpoints(broken)) == []
        logs = [
            [
                {name: value for name, value in row.items() if name not in ("time/fps", "time/time_elapsed")}
                for row in read_progress(out)
            ]
            for out in (alone, broken)
        ]
        assert len(logs[0]) >= 3
        assert logs[0] == logs[1]
        a, b = (SkillGraphAgent.load(out / "agent.zip") for out in (alone, broken))
        assert differences(without_clock(state_of(a)), without_clock(state_of(b))) == []
        assert "holds an agent already" in error_line(capsys, [*command, str(broken)])

    def test_a_run_broken_off_before_its_first_checkpoint_begins_anew(self, tmp_path, capsys, monkeypatch):
        def interrupt(self):
            if self.num_timesteps == 120:
                raise KeyboardInterrupt
            return True

        alone, broken = tmp_path / "alone", tmp_path / "broken"
        command = ["train", TOY, "--steps", "300", "--hyperparams", "learning_starts=100", "--out"]
        assert cli.main([*command, str(alone)]) == 0
        with monkeypatch.context() as patch:
            patch.setattr(SkillGraphProgressBarCallback, "_on_step", interrupt)
            assert cli.main([*command, str(broken)]) == 130
        assert "the same command goes on after 0 steps" in capsys.readouterr().out
        assert SkillGraphAgent.load(broken / "agent.zip").num_timesteps == 120
        assert "unfinished run with other settings" in error_line(capsys, [*command, str(broken), "--seed", "1"])
        assert cli.main([*command, str(broken)]) == 0
        a, b = (SkillGraphAgent.load(out / "agent.zip") for out in (alone, broken))
        assert differences(without_clock(state_of(a)), without_clock(state_of(b))) == []
        assert "holds an agent already" in error_line(capsys, [*command, str(broken)])

    def test_several_environments_that_overshoot_checkpoints(self, tmp_path, capsys, monkeypatch):
        monkeypatch.setattr(training, "CHECKPOINT_EVERY", 100)
        command = ["train", TOY, "--steps", "500", "--n-envs", "6", "--out", str(tmp_path)]
        assert cli.main(command) == 0
        assert "goes on" not in capsys.readouterr().out
        assert SkillGraphAgent.load(tmp_path / "agent.zip").num_timesteps == 504  # the first multiple of 6
        assert "holds an agent already" in error_line(capsys, command)

    def test_what_fails_at_its_first_step_does_not_block_the_folder(self, tmp_path, monkeypatch):
        def fail(self):
            raise RuntimeError("at the first step")

        command = ["train", TOY, "--steps", "50", "--out", str(tmp_path)]
        with monkeypatch.context() as patch:
            patch.setattr(SkillGraphProgressBarCallback, "_on_training_start", fail)
            with pytest.raises(RuntimeError, match="first step"):
                cli.main(command)
        assert cli.main([*command, "--seed", "1"]) == 0

    def test_takes_steps_from_yaml_and_names_the_folder(self, tmp_path, monkeypatch):
        calls = []
        monkeypatch.setattr(cli, "train", lambda *args: calls.append(args))
        monkeypatch.chdir(tmp_path)
        assert cli.main(["train", "SkillGraph/AntUMaze-v0", "--hyperparams", "gamma=0.9"]) == 0
        _, _, hyperparams, steps, seed, out, *_ = calls[0]
        assert steps == load_hyperparams("SkillGraph/AntUMaze-v0")["n_timesteps"]
        assert hyperparams["gamma"] == 0.9 and hyperparams["option_class"] is OptionTD3
        assert (seed, out) == (0, Path("runs/AntUMaze-v0-seed0"))
        assert cli.main(["train", TOY, "--hyperparams-of", "SkillGraph/AntUMaze-v0", "--hyperparams", "gamma=0.9"]) == 0
        assert calls[1][0] == TOY and calls[1][2:4] == (hyperparams, steps)


class TestErrors:
    @pytest.mark.parametrize(
        ("argv", "words"),
        [
            (["train", "SkillGraph/ToyMaz-v0"], "did you mean 'SkillGraph/ToyMaze-v0'"),
            (["train", "ToyMaze-v0"], "did you mean"),
            (["train", "no_such_package:Env-v0"], "no_such_package"),
            (["train", "CartPole-v1"], "goal environment"),
            (["train", TOY, "--hyperparams", "gama=0.9"], "did you mean 'gamma'"),
            (["train", TOY, "--hyperparams-of", "SkillGraph/AntUMze-v0"], "did you mean 'SkillGraph/AntUMaze-v0'"),
            (["train", TOY, "--hyperparams", "gamma=high"], "gamma must be a number, not 'high'"),
            (["train", TOY, "--hyperparams", "salience=magic"], "Unknown salience 'magic'"),
            (["train", TOY, "--hyperparams", "option_class=PPO"], "OptionDDPG"),
            (["train", TOY, "--hyperparams", "gamma"], "NAME=VALUE"),
            (["train", TOY, "--steps", "0"], "at least 1"),
            (["train", TOY, "--env-kwargs", "maze=1"], "maze"),
            (["train", "SkillGraph/PointMaze-v0"], "maze_map is required"),
            (["evaluate", "nothing.zip", "--env", TOY], "no file"),
            (["plot", "nothing.zip", "--env", TOY, "--out", "x"], "no file"),
            (["evaluate", "nothing.zip", "--env", "CartPole-v1"], "maze"),
            (["evaluate", "nothing.zip"], "--env"),
            (["dance"], "dance"),
        ],
    )
    def test_one_line_and_code_2(self, argv, words, capsys, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        assert words in error_line(capsys, argv)
        assert not list(tmp_path.iterdir())

    def test_damaged_file(self, trained, tmp_path, capsys):
        damaged = tmp_path / "agent.zip"
        damaged.write_bytes((trained / "agent.zip").read_bytes()[:1000])
        assert "damaged" in error_line(capsys, ["evaluate", str(damaged), "--env", TOY])

    def test_wrong_environment(self, trained, capsys):
        argv = ["evaluate", str(trained / "agent.zip"), "--env", "SkillGraph/PointMazeUMaze-v0"]
        assert "spaces do not match" in error_line(capsys, argv)

    def test_maze_without_room_for_pairs(self, trained, capsys):
        argv = ["evaluate", str(trained / "agent.zip"), "--env", TOY, "--env-kwargs", "maze_map=[[1,1,1],[1,0,1],[1,1,1]]"]
        assert "too small" in error_line(capsys, argv)


class TestEvaluateAndPlot:
    def test_evaluate_writes_every_pair(self, trained, tmp_path, capsys):
        out = tmp_path / "result.json"
        argv = ["evaluate", str(trained / "agent.zip"), "--env", TOY, "--pairs", "4", "--seed", "1", "--out", str(out)]
        assert cli.main(argv) == 0
        result = json.loads(out.read_text())
        assert len(result["pairs"]) == 4
        assert result["success_rate"] == sum(pair["success"] for pair in result["pairs"]) / 4
        assert all(pair["trace"]["n_successes"] <= pair["trace"]["n_runs"] for pair in result["pairs"])
        assert "95 % interval" in capsys.readouterr().out

    def test_adapt_and_no_planning(self, trained):
        argv = ["evaluate", str(trained / "agent.zip"), "--env", TOY, "--pairs", "1"]
        assert cli.main([*argv, "--no-planning"]) == 0
        assert cli.main([*argv, "--adapt", "20"]) == 0

    def test_adapts_from_the_experience_of_training(self, trained, tmp_path, capsys, monkeypatch):
        known = []

        def look(agent, *args, **kwargs):
            known.append(agent.store.total)
            return evaluate_pairs(agent, *args, **{**kwargs, "adapt_timesteps": 0})

        monkeypatch.setattr(cli, "evaluate_pairs", look)
        assert cli.main(["train", TOY, "--steps", "150", "--out", str(tmp_path)]) == 0
        argv = ["evaluate", str(tmp_path / "agent.zip"), "--env", TOY, "--pairs", "1", "--adapt", "20"]
        assert cli.main(argv) == 0
        assert "without what it met" not in capsys.readouterr().out
        (tmp_path / "experience.zip").unlink()
        assert cli.main(argv) == 0
        assert "without what it met in training: There is no file" in capsys.readouterr().out
        assert cli.main(["evaluate", str(trained / "agent.zip"), *argv[2:]]) == 0
        assert "without what it met in training: The stored replay buffer has n_envs=2" in capsys.readouterr().out
        assert known == [150, 0, 0]

    def test_plot_leaves_two_pictures(self, trained, tmp_path):
        assert cli.main(["plot", str(trained / "agent.zip"), "--env", TOY, "--out", str(tmp_path)]) == 0
        assert {path.name for path in tmp_path.iterdir()} == {"skill_graph.png", "plan.png"}


def test_demo_leaves_everything(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(cli, "DEMO_ENV", TOY)
    assert cli.main(["demo", "--steps", "300", "--pairs", "3", "--out", str(tmp_path)]) == 0
    expected = {"agent.zip", "experience.zip", "progress.csv", "config.json", "results.json", "skill_graph.png", "plan.png"}
    assert {path.name for path in tmp_path.iterdir()} == expected
    results = json.loads((tmp_path / "results.json").read_text())
    assert list(results) == ["skill graph", "planning off", "random walk"]
    assert all(len(result["pairs"]) == 3 for result in results.values())
    printed = capsys.readouterr().out
    assert "random walk" in printed and "coverage" in printed


@pytest.mark.parametrize("command", ["train", "evaluate", "plot", "demo"])
def test_help_shows_an_example(command, capsys):
    with pytest.raises(SystemExit) as exit_:
        cli.main([command, "--help"])
    assert exit_.value.code == 0
    assert f"example:\n  sb3-skillgraph {command}" in capsys.readouterr().out


class TestHyperparams:
    @pytest.mark.parametrize("env_id", _TASKS)
    def test_every_environment_has_an_entry(self, env_id):
        assert env_id in yaml.safe_load(FILE.read_text())
        hyperparams = load_hyperparams(env_id)
        assert hyperparams["n_timesteps"] > 0 and hyperparams["policy"] == "MultiInputPolicy"

    def test_an_environment_without_entry_gets_the_defaults(self):
        assert load_hyperparams("Mine-v0") == {"n_timesteps": 100_000, "policy": "MultiInputPolicy"}

    @pytest.mark.parametrize(
        ("text", "words"),
        [
            ("Mine-v0: {learning_rat: 1}", "custom.yml, entry 'Mine-v0': unknown argument 'learning_rat'; did you mean"),
            ("Mine-v0: [1, 2]", "custom.yml, entry 'Mine-v0': a mapping"),
            ("[1, 2]", "custom.yml: a mapping"),
            ("Mine-v0: {", "custom.yml is no valid YAML"),
        ],
    )
    def test_mistakes_name_file_and_entry(self, text, words, tmp_path):
        path = tmp_path / "custom.yml"
        path.write_text(text)
        with pytest.raises(ValueError) as error:
            load_hyperparams("Mine-v0", path)
        assert str(error.value).startswith(words)

    def test_an_entry_wins_over_defaults(self, tmp_path):
        path = tmp_path / "custom.yml"
        path.write_text("defaults: {gamma: 0.9, n_timesteps: 1e5}\nMine-v0: {gamma: 0.95, learning_rate: 1e-3}\n")
        expected = {"gamma": 0.95, "n_timesteps": 100_000, "learning_rate": 0.001}
        assert load_hyperparams("Mine-v0", path) == expected
