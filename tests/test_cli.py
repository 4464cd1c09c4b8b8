"""The command line: what it leaves, how it goes on, and what it says to mistakes."""

import csv
import json
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
import yaml
from conftest import TOY, differences, state_of, without_clock

from sb3_skillgraph import SkillGraphAgent, cli
from sb3_skillgraph.baselines import StraightOn
from sb3_skillgraph.envs import _TASKS
from sb3_skillgraph.evaluation import evaluate_pairs
from sb3_skillgraph.experiments import training
from sb3_skillgraph.experiments.run_folder import checkpoints, read_progress
from sb3_skillgraph.hyperparams import FILE, load_hyperparams
from sb3_skillgraph.options.learner import OptionTD3

Capture = pytest.CaptureFixture[str]
PICTURES = {"skill_graph.png", "plan.png"}
TRAINED = {"agent.zip", "experience.zip", "progress.csv", "config.json", "done.json", "lock"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What ``train`` leaves."""
    out = tmp_path_factory.mktemp("cli") / "toy"
    arguments = ["--steps", "600", "--seed", "3", "--n-envs", "2", "--hyperparams", "learning_starts=100", "tau=1e-2"]
    assert cli.main(["train", TOY, "--out", str(out), *arguments, "--env-kwargs", "max_steps=50"]) == 0
    return out


def error_line(capsys: Capture, argv: Sequence[str]) -> str:
    try:
        code: Any = cli.main(argv)
    except SystemExit as error:  # argparse's own way out
        code = error.code
    captured = capsys.readouterr()
    assert code == 2
    assert captured.err.count("\n") == 1, captured.err
    assert captured.err.startswith("sb3-skillgraph")
    return captured.err


def interrupt_at(n_steps: int, *, twice: bool = False) -> Callable[[training.Clock], bool]:
    """Stands in for the clock's step: Ctrl-C after so many."""

    def on_step(clock: training.Clock) -> bool:
        if clock.num_timesteps == n_steps:
            signal.raise_signal(signal.SIGINT)
            if twice:
                signal.raise_signal(signal.SIGINT)
        return True

    return on_step


def same_agents(one: Path, other: Path) -> bool:
    agents = (SkillGraphAgent.load(out / "agent.zip") for out in (one, other))
    a, b = (without_clock(state_of(agent)) for agent in agents)
    return differences(a, b) == []


# -- train ------------------------------------------------------------------------------------------------------------


def test_training_leaves_agent_log_and_configuration(folder: Path) -> None:
    assert {path.name for path in folder.iterdir()} == {*TRAINED, "graph_500.json", "graph_600.json"}
    agent = SkillGraphAgent.load(folder / "agent.zip")
    assert agent.num_timesteps == 600
    assert agent.seed == 3 and agent.n_envs == 2 and agent.tau == 0.01
    rows = list(csv.DictReader((folder / "progress.csv").read_text().splitlines()))
    assert {"skillgraph/events", "skillgraph/edges", "skillgraph/success_rate"} <= rows[-1].keys()
    config = json.loads((folder / "config.json").read_text())
    assert config["env"] == TOY and config["seed"] == 3 and config["steps"] == 600
    assert config["env_kwargs"] == {"max_steps": 50}
    assert config["arguments"]["learning_starts"] == 100
    assert "torch" in config["versions"]


def test_training_does_not_overwrite_an_agent(folder: Path, capsys: Capture) -> None:
    before = (folder / "agent.zip").read_bytes()
    assert "holds a run with other settings" in error_line(capsys, ["train", TOY, "--out", str(folder)])
    assert (folder / "agent.zip").read_bytes() == before


def test_an_interrupted_run_goes_on_and_comes_to_the_same(
    tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(training, "CHECKPOINT_EVERY", 200)
    alone, broken = tmp_path / "alone", tmp_path / "broken"
    command = ["train", TOY, "--steps", "700", "--hyperparams", "learning_starts=100", "--env-kwargs", "max_steps=50", "--out"]
    assert cli.main([*command, str(alone)]) == 0
    assert list(checkpoints(alone)) == []
    with monkeypatch.context() as patch:
        patch.setattr(training.Clock, "_on_step", interrupt_at(530, twice=True))
        assert cli.main([*command, str(broken)]) == 130
    assert "the same command goes on after 400 steps" in capsys.readouterr().out
    assert "run with other settings" in error_line(capsys, [*command, str(broken), "--seed", "1"])
    assert cli.main([*command, str(broken)]) == 0
    assert "going on after 400 steps" in capsys.readouterr().out
    assert list(checkpoints(broken)) == []
    clock = ("time/fps", "time/time_elapsed")
    logs = [
        [{name: value for name, value in row.items() if name not in clock} for row in read_progress(out)]
        for out in (alone, broken)
    ]
    assert len(logs[0]) >= 3
    assert logs[0] == logs[1]
    assert same_agents(alone, broken)
    assert "holds an agent already" in error_line(capsys, [*command, str(broken)])


def test_a_run_broken_off_before_its_first_checkpoint_is_saved_and_begins_anew(
    tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    alone, broken = tmp_path / "alone", tmp_path / "broken"
    command = ["train", TOY, "--steps", "300", "--hyperparams", "learning_starts=100", "--out"]
    assert cli.main([*command, str(alone)]) == 0
    capsys.readouterr()
    with monkeypatch.context() as patch:
        patch.setattr(training.Clock, "_on_step", interrupt_at(120, twice=True))
        assert cli.main([*command, str(broken)]) == 130
    captured = capsys.readouterr()
    assert "interrupted" in captured.err and "agent.zip" in captured.out
    assert "the same command goes on after 0 steps" in captured.out
    assert SkillGraphAgent.load(broken / "agent.zip").num_timesteps == 120
    assert "run with other settings" in error_line(capsys, [*command, str(broken), "--seed", "1"])
    assert cli.main([*command, str(broken)]) == 0
    assert same_agents(alone, broken)
    assert "holds an agent already" in error_line(capsys, [*command, str(broken)])


def test_several_environments_that_overshoot_checkpoints(
    tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(training, "CHECKPOINT_EVERY", 100)
    command = ["train", TOY, "--steps", "500", "--n-envs", "6", "--out", str(tmp_path)]
    assert cli.main(command) == 0
    assert "goes on" not in capsys.readouterr().out
    assert SkillGraphAgent.load(tmp_path / "agent.zip").num_timesteps == 504  # the first multiple of 6
    assert "holds an agent already" in error_line(capsys, command)


def test_what_fails_at_its_first_step_does_not_block_the_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(_: Any) -> None:
        raise RuntimeError("at the first step")

    command = ["train", TOY, "--steps", "50", "--out", str(tmp_path)]
    with monkeypatch.context() as patch:
        patch.setattr(training.Clock, "_on_training_start", fail)
        with pytest.raises(RuntimeError, match="first step"):
            cli.main(command)
    assert cli.main([*command, "--seed", "1"]) == 0


def test_training_takes_steps_from_yaml_and_names_the_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[tuple[Any, ...]] = []
    monkeypatch.setattr(cli, "train", lambda *args: calls.append(args))
    monkeypatch.chdir(tmp_path)
    assert cli.main(["train", "SkillGraph/AntUMaze-v0", "--hyperparams", "gamma=0.9"]) == 0
    _, _, hyperparams, steps, seed, out, *_ = calls[0]
    assert steps == load_hyperparams("SkillGraph/AntUMaze-v0")["n_timesteps"]
    assert hyperparams["gamma"] == 0.9 and hyperparams["option_class"] is OptionTD3
    assert (seed, out) == (0, Path("runs/AntUMaze-v0-seed0"))
    assert cli.main(["train", TOY, "--hyperparams-of", "SkillGraph/AntUMaze-v0", "--hyperparams", "gamma=0.9"]) == 0
    assert calls[1][0] == TOY and calls[1][2:4] == (hyperparams, steps)


def test_ctrl_c_keeps_everything_and_the_run_goes_on_from_there(
    tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(training, "STOP_EVERY", 50)
    alone, broken = tmp_path / "alone", tmp_path / "broken"
    command = ["train", TOY, "--steps", "4e2", "--hyperparams", "learning_starts=100", "--out"]
    assert cli.main([*command, str(alone)]) == 0
    assert "400 of 400 steps: " in capsys.readouterr().out
    with monkeypatch.context() as patch:
        patch.setattr(training.Clock, "_on_step", interrupt_at(120))
        assert cli.main([*command, str(broken)]) == 130
    printed = capsys.readouterr().out
    assert "stopping soon" in printed and "the same command goes on after 150 steps" in printed
    assert cli.main([*command, str(broken)]) == 0
    assert "going on after 150 steps" in capsys.readouterr().out
    assert same_agents(alone, broken)
    elapsed = [float(row["time/time_elapsed"]) for row in read_progress(broken)]
    assert elapsed == sorted(elapsed)


def test_a_finished_agent_is_trained_further(tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    command = ["train", TOY, "--hyperparams", "learning_starts=50", "--out", str(tmp_path), "--tensorboard", "--steps"]
    assert cli.main([*command, "200"]) == 0
    assert list(tmp_path.glob("events.out.tfevents.*"))
    assert "of 200 steps: give more --steps" in error_line(capsys, [*command, "200"])
    with monkeypatch.context() as patch:
        patch.setattr(training.Clock, "_on_step", interrupt_at(230, twice=True))
        assert cli.main([*command, "300"]) == 130
    assert cli.main([*command, "300"]) == 0
    assert capsys.readouterr().out.count("going on after 200 steps") == 2
    agent = SkillGraphAgent.load(tmp_path / "agent.zip")
    assert agent.num_timesteps == 300
    assert checkpoints(tmp_path) == {}
    assert json.loads((tmp_path / "config.json").read_text())["steps"] == 300


def test_the_package_is_the_command_line() -> None:
    done = subprocess.run([sys.executable, "-m", "sb3_skillgraph", "--version"], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["0.2.0"]


# -- mistakes ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["train", "SkillGraph/ToyMaz-v0"], "did you mean 'SkillGraph/ToyMaze-v0'"),
        (["train", "ToyMaze-v0"], "did you mean 'SkillGraph/ToyMaze-v0'"),
        (["train", "no_such_package:Env-v0"], "no_such_package"),
        (["train", "CartPole-v1"], "goal environment"),
        (["train", TOY, "--hyperparams", "gama=0.9"], "did you mean 'gamma'"),
        (["train", TOY, "--hyperparams-of", "SkillGraph/AntUMze-v0"], "did you mean 'SkillGraph/AntUMaze-v0'"),
        (["train", TOY, "--hyperparams", "gamma=high"], "gamma must be a number, not 'high'"),
        (["train", TOY, "--hyperparams", "gamma=1.5"], "gamma must be a number from 0 to 1"),
        (["train", TOY, "--hyperparams", "salience=magic"], "Unknown salience 'magic'"),
        (["train", TOY, "--hyperparams", "option_class=PPO"], "OptionDDPG"),
        (["train", TOY, "--hyperparams", "gamma"], "NAME=VALUE"),
        (["train", TOY, "--steps", "0"], "at least 1"),
        (["train", TOY, "--env-kwargs", "maze=1"], "maze"),
        (["train", "SkillGraph/PointMaze-v0"], "maze_map is required"),
        (["train", "FetchReech-v4"], "did you mean 'FetchReach-v4'"),
        (["train", TOY, "--hyperparams", "tensorboard_log=tb"], "--tensorboard writes the log into OUT"),
        (["train", TOY, "--hyperparams", "event_radius={parts: [{kind: Withn, dims: [0, 1], radius: 0.3}]}"], "not 'Withn'"),
        (["evaluate", "nothing.zip", "--env", TOY], "there is no nothing.zip"),
        (["plot", "nothing.zip", "--env", TOY, "--out", "x"], "there is no nothing.zip"),
        (["evaluate", "nothing"], "there is no nothing: give a folder that train has filled, or an agent.zip"),
        (["train", TOY, "--steps", "1.5"], "whole number"),
        (["dance"], "dance"),
    ],
)
def test_a_mistake_gets_one_line_and_code_2(
    argv: list[str], words: str, capsys: Capture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert words in error_line(capsys, argv)
    assert not list(tmp_path.iterdir())


def test_a_damaged_file_is_called_so(folder: Path, tmp_path: Path, capsys: Capture) -> None:
    damaged = tmp_path / "agent.zip"
    damaged.write_bytes((folder / "agent.zip").read_bytes()[:1000])
    assert "damaged" in error_line(capsys, ["evaluate", str(damaged), "--env", TOY])


def test_an_environment_that_does_not_fit_is_refused(folder: Path, capsys: Capture) -> None:
    argv = ["evaluate", str(folder / "agent.zip"), "--env", "SkillGraph/PointMazeUMaze-v0"]
    assert "spaces do not match" in error_line(capsys, argv)


def test_a_maze_without_room_for_pairs_is_refused(folder: Path, capsys: Capture) -> None:
    maze = ["--env-kwargs", "maze_map=[[1,1,1],[1,0,1],[1,1,1]]", "--pairs", "1"]
    assert "too small" in error_line(capsys, ["evaluate", str(folder / "agent.zip"), "--env", TOY, *maze])


@pytest.mark.parametrize("seed", ["-1", "one", str(2**32)])
@pytest.mark.parametrize("command", ["evaluate", "plot"])
def test_seeds_are_whole_numbers(folder: Path, command: str, seed: str, capsys: Capture) -> None:
    assert "a seed is a whole number from 0 to 4294967295" in error_line(capsys, [command, str(folder), "--seed", seed])


# -- evaluate and plot ------------------------------------------------------------------------------------------------


def test_evaluate_writes_every_pair(folder: Path, tmp_path: Path, capsys: Capture) -> None:
    out = tmp_path / "result.json"
    argv = ["evaluate", str(folder / "agent.zip"), "--env", TOY, "--pairs", "4", "--seed", "1", "--out", str(out)]
    assert cli.main(argv) == 0
    result = json.loads(out.read_text())
    assert len(result["pairs"]) == 4
    assert result["success_rate"] == sum(pair["success"] for pair in result["pairs"]) / 4
    assert all(0 <= pair["trace"]["n_successes"] <= pair["trace"]["n_runs"] <= pair["steps"] for pair in result["pairs"])
    assert all(0.0 < pair["trace"]["promised"] <= 1.0 for pair in result["pairs"])
    printed = capsys.readouterr().out
    assert "95 % interval" in printed and str(out) in "".join(printed.split("\n"))


def test_a_run_knows_its_environment(folder: Path, tmp_path: Path, capsys: Capture) -> None:
    result = tmp_path / "result.json"
    assert cli.main(["evaluate", str(folder), "--pairs", "2", "--out", str(result)]) == 0
    captured = capsys.readouterr()
    assert "trained in" not in captured.out and "2/2" in captured.err  # the progress bar
    assert all(pair["steps"] <= 50 for pair in json.loads(result.read_text())["pairs"])  # its max_steps, too
    assert cli.main(["evaluate", str(folder), "--env", TOY, "--pairs", "1"]) == 0
    warning = f"warning: the agent was trained in {TOY} {{'max_steps': 50}}"
    assert warning in capsys.readouterr().out
    assert cli.main(["evaluate", str(folder), "--env-kwargs", "max_steps=4e1", "--pairs", "1"]) == 0
    assert warning in capsys.readouterr().out
    assert cli.main(["plot", str(folder), "--out", str(tmp_path)]) == 0
    assert {path.name for path in tmp_path.iterdir()} >= PICTURES


def test_settings_of_a_run_are_looked_at_first(tmp_path: Path, capsys: Capture) -> None:
    argv = ["train", TOY, "--steps", "20", "--out", str(tmp_path), "--hyperparams"]
    assert cli.main([*argv, "event_radius=0.4"]) == 0
    assert "holds a run with other settings" in error_line(capsys, [*argv, "event_radius=-1"])


def test_pairs_go_to_a_file(folder: Path, tmp_path: Path, capsys: Capture) -> None:
    assert f"{tmp_path} is a folder" in error_line(capsys, ["evaluate", str(folder), "--out", str(tmp_path)])


def test_a_folder_without_an_agent(folder: Path, tmp_path: Path, capsys: Capture) -> None:
    assert f"there is no agent.zip in {tmp_path}" in error_line(capsys, ["evaluate", str(tmp_path), "--env", TOY])
    (tmp_path / "checkpoint_300").mkdir()
    argv = ["evaluate", str(tmp_path / "checkpoint_300")]
    assert "there are checkpoints: checkpoint_300" in error_line(capsys, ["evaluate", str(tmp_path), "--env", TOY])
    (tmp_path / "checkpoint_300" / "agent.zip").write_bytes((folder / "agent.zip").read_bytes())
    assert "say with --env in which environment" in error_line(capsys, argv)


def test_numbers_may_be_written_as_people_do(tmp_path: Path) -> None:
    given = ["event_radius=3e-1", "learning_rate=1e-4", "train_freq=[1, episode]", "batch_size=1e1", "buffer_size=1.5e3"]
    argv = ["train", TOY, "--steps", "1e1", "--out", str(tmp_path), "--env-kwargs", "max_steps=2e1", "--hyperparams", *given]
    assert cli.main(argv) == 0
    agent = SkillGraphAgent.load(tmp_path / "agent.zip")
    assert (agent.event_radius, agent.learning_rate, agent.batch_size, agent.buffer_size) == (0.3, 1e-4, 10, 1500)
    assert (agent.train_freq.frequency, agent.train_freq.unit.value) == (1, "episode")
    assert json.loads((tmp_path / "config.json").read_text())["env_kwargs"] == {"max_steps": 20}


def test_adaptation_needs_starts_and_goals_of_ones_choice(tmp_path: Path, capsys: Capture) -> None:
    assert cli.main(["train", "FetchReach-v4", "--steps", "50", "--out", str(tmp_path)]) == 0
    assert "must take start and goal" in error_line(capsys, ["evaluate", str(tmp_path), "--adapt", "10", "--pairs", "1"])


def test_a_damaged_configuration_is_called_so(folder: Path, tmp_path: Path, capsys: Capture) -> None:
    (tmp_path / "agent.zip").write_bytes((folder / "agent.zip").read_bytes())
    (tmp_path / "config.json").write_text("{")
    assert "config.json is damaged" in error_line(capsys, ["evaluate", str(tmp_path)])


def test_evaluate_can_do_without_plans(folder: Path, tmp_path: Path, capsys: Capture) -> None:
    out = tmp_path / "result.json"
    argv = ["evaluate", str(folder / "agent.zip"), "--env", TOY, "--pairs", "3", "--seed", "1"]
    assert cli.main([*argv, "--straight-on", "--out", str(out)]) == 0
    pairs = json.loads(out.read_text())["pairs"]
    assert [pair["trace"] for pair in pairs] == [None] * 3
    agent = SkillGraphAgent.load(folder / "agent.zip", env=gym.make(TOY))
    expected = evaluate_pairs(StraightOn(agent), TOY, n_pairs=3, seed=1)
    assert [(pair["success"], pair["steps"]) for pair in pairs] == [(pair.success, pair.steps) for pair in expected.pairs]
    capsys.readouterr()
    assert "do not go together" in error_line(capsys, [*argv, "--straight-on", "--adapt", "20"])


def test_evaluate_adapts_from_the_experience_of_training(
    folder: Path, tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    known: list[int] = []

    def look(agent: SkillGraphAgent, *args: Any, **kwargs: Any) -> Any:
        known.append(agent.parts.store.total)
        assert kwargs["adapt_timesteps"] == 20
        return evaluate_pairs(agent, *args, **kwargs)

    monkeypatch.setattr(cli, "evaluate_pairs", look)
    assert cli.main(["train", TOY, "--steps", "150", "--out", str(tmp_path)]) == 0
    argv = ["evaluate", str(tmp_path / "agent.zip"), "--env", TOY, "--pairs", "1", "--adapt", "20"]
    assert cli.main(argv) == 0
    assert "without what it met" not in capsys.readouterr().out
    (tmp_path / "experience.zip").unlink()
    assert cli.main(argv) == 0
    assert "without what it met in training: There is no file" in capsys.readouterr().out
    assert cli.main(["evaluate", str(folder / "agent.zip"), *argv[2:]]) == 0
    assert "without what it met in training: The stored replay buffer has n_envs=2" in capsys.readouterr().out
    assert known == [150, 0, 0]


def test_plot_leaves_two_pictures(folder: Path, tmp_path: Path) -> None:
    assert cli.main(["plot", str(folder / "agent.zip"), "--env", TOY, "--out", str(tmp_path)]) == 0
    assert {path.name for path in tmp_path.iterdir()} == PICTURES
    assert all((tmp_path / name).read_bytes().startswith(b"\x89PNG") for name in PICTURES)


@pytest.mark.mujoco
def test_demo_leaves_agent_table_results_and_pictures(
    tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fewer_steps(*args: Any, **kwargs: Any) -> Any:
        return evaluate_pairs(*args, **kwargs, env_kwargs={"max_steps": 150})

    monkeypatch.setattr(cli, "evaluate_pairs", fewer_steps)
    monkeypatch.setenv("COLUMNS", "120")
    assert cli.main(["demo", "--steps", "600", "--pairs", "3", "--out", str(tmp_path)]) == 0
    left = {path.name for path in tmp_path.iterdir() if not path.name.startswith("graph_")}
    assert left == TRAINED | PICTURES | {"results.json"}
    assert all((tmp_path / name).read_bytes().startswith(b"\x89PNG") for name in PICTURES)
    methods = ["skill graph", "walker, straight on", "random walk"]
    results = json.loads((tmp_path / "results.json").read_text())
    assert list(results) == methods
    assert all(len(result["pairs"]) == 3 for result in results.values())
    assert [bool(result["pairs"][0]["trace"]) for result in results.values()] == [True, False, False]
    endpoints = [[(pair["start"], pair["goal"]) for pair in result["pairs"]] for result in results.values()]
    assert endpoints[0] == endpoints[1] == endpoints[2]
    printed = " ".join(capsys.readouterr().out.split())
    assert all(method in printed for method in methods)
    assert "goals reached" in printed and "mean steps there" in printed
    assert SkillGraphAgent.load(tmp_path / "agent.zip").num_timesteps == 600


@pytest.mark.parametrize("command", ["train", "evaluate", "plot", "demo", "compare", "status"])
def test_help_shows_an_example(command: str, capsys: Capture) -> None:
    with pytest.raises(SystemExit) as exit_:
        cli.main([command, "--help"])
    assert exit_.value.code == 0
    assert f"example:\n  sb3-skillgraph {command}" in capsys.readouterr().out


# -- recommended hyperparameters --------------------------------------------------------------------------------------


@pytest.mark.parametrize("env_id", _TASKS)
def test_every_environment_has_an_entry(env_id: str) -> None:
    hyperparams = load_hyperparams(env_id)
    assert hyperparams["n_timesteps"] > 0 and hyperparams["policy"] == "MultiInputPolicy"
    assert env_id in yaml.safe_load(FILE.read_text())


def test_an_environment_without_entry_gets_the_defaults() -> None:
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
def test_mistakes_in_yaml_name_file_and_entry(text: str, words: str, tmp_path: Path) -> None:
    path = tmp_path / "custom.yml"
    path.write_text(text)
    with pytest.raises(ValueError) as error:
        load_hyperparams("Mine-v0", path)
    assert str(error.value).startswith(words)


def test_an_entry_wins_over_defaults(tmp_path: Path) -> None:
    path = tmp_path / "custom.yml"
    path.write_text("defaults: {gamma: 0.9, n_timesteps: 1e5}\nMine-v0: {gamma: 0.95, learning_rate: 1e-3}\n")
    assert load_hyperparams("Mine-v0", path) == {"gamma": 0.95, "n_timesteps": 100_000, "learning_rate": 0.001}


# -- other people's environments --------------------------------------------------------------------------------------

PACKAGE = '''
import gymnasium as gym
import numpy as np
from sb3_skillgraph.envs import ToyMazeEnv


class Mine(ToyMazeEnv):
    """An environment of somebody's own."""


gym.register("Mine-v0", entry_point=Mine)
'''


@pytest.mark.parametrize("env_id", ["gymnasium_robotics:FetchReach-v4", "FetchReach-v4", "my_own_mazes:Mine-v0"])
def test_environments_of_other_packages_are_found(env_id: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "my_own_mazes.py").write_text(PACKAGE)
    monkeypatch.syspath_prepend(tmp_path)
    out, settings = tmp_path / "run", ["--hyperparams", "learning_starts=100"]
    assert cli.main(["train", env_id, "--out", str(out), "--steps", "150", *settings]) == 0
    assert {path.name for path in out.iterdir()} == {*TRAINED, "graph_150.json"}
    # All else, too: to train it further, to test it and to draw it
    assert cli.main(["train", env_id, "--out", str(out), "--steps", "200", *settings]) == 0
    assert cli.main(["evaluate", str(out), "--pairs", "2"]) == 0
    assert cli.main(["plot", str(out), "--out", str(out)]) == 0
    assert {*PICTURES, "graph_200.json"} <= {path.name for path in out.iterdir()}


def test_a_package_that_is_not_there_is_named(capsys: Capture) -> None:
    assert "No module named 'no_such_package'" in error_line(capsys, ["train", "no_such_package:Mine-v0"])
