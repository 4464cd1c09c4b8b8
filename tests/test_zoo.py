"""The zoo's own scripts train our algorithm, go on with it, show it and tune it."""

import sys
from pathlib import Path

import pytest
import yaml
from conftest import TOY

from sb3_skillgraph import SkillGraphAgent, zoo
from sb3_skillgraph.hyperparams import load_hyperparams, recommended_wrapper

pytestmark = pytest.mark.filterwarnings("ignore")
FOLDER = "dsg/SkillGraph-ToyMaze-v0_1"


def run(monkeypatch: pytest.MonkeyPatch, script: str, *arguments: object) -> None:
    monkeypatch.setattr(sys, "argv", ["zoo", script, "--algo", "dsg", "--env", TOY, *map(str, arguments)])
    zoo.main()


def test_the_zoo_trains_goes_on_enjoys_and_tunes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    logs = tmp_path / "logs"
    monkeypatch.chdir(tmp_path)
    run(monkeypatch, "train", "-n", 300, "-f", logs, "-tb", tmp_path / "tb", "--eval-freq", 150, "--eval-episodes", 1)
    agent = SkillGraphAgent.load(logs / FOLDER / "SkillGraph-ToyMaze-v0.zip")
    assert agent.num_timesteps == 300
    assert list((tmp_path / "tb").rglob("events.out.tfevents.*"))
    assert (logs / FOLDER / "evaluations.npz").exists()
    run(monkeypatch, "enjoy", "-f", logs, "--no-render", "-n", 30)
    before = logs / FOLDER / "SkillGraph-ToyMaze-v0.zip"
    run(monkeypatch, "train", "-n", 100, "-f", logs, "--eval-freq", -1, "-i", before)
    assert SkillGraphAgent.load(logs / "dsg/SkillGraph-ToyMaze-v0_2/SkillGraph-ToyMaze-v0.zip").num_timesteps == 100
    tuned = ["-optimize", "--n-trials", 1, "--n-evaluations", 1, "--eval-episodes", 1]
    run(monkeypatch, "train", "-n", 150, "-f", logs, *tuned)
    assert "Number of finished trials:  1" in capsys.readouterr().out


def test_the_zoos_hyperparameters_are_those_of_the_command_line() -> None:
    for env_id, entry in zoo.read_hyperparams().items():
        if env_id != "default":
            assert ("env_wrapper" in entry) == (recommended_wrapper(env_id) is not None)
            entry.pop("env_wrapper", None)  # the zoo puts it around by itself
            ours = load_hyperparams(env_id)
            assert entry.keys() == ours.keys()
            assert all(ours[name] == value for name, value in entry.items() if name != "option_class")
            assert "option_class" not in entry or ours["option_class"].__name__ == entry["option_class"]
    assert zoo.hyperparams["AntMaze_UMaze-v5"]["env_wrapper"] == "sb3_skillgraph.envs.AntRecipe"
    assert zoo.hyperparams["default"] == {"n_timesteps": 100_000, "policy": "MultiInputPolicy"}


def test_schedules_and_numbers_of_another_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    entry = {"n_timesteps": 200, "policy": "MultiInputPolicy", "learning_rate": "lin_1e-3", "option_class": "OptionTD3"}
    (tmp_path / "own.yml").write_text(yaml.safe_dump({TOY: {**entry, "train_freq": [1, "episode"]}}))
    run(monkeypatch, "train", f"--conf-file={tmp_path / 'own.yml'}", "-f", tmp_path, "--eval-freq", -1)
    agent = SkillGraphAgent.load(tmp_path / FOLDER / "SkillGraph-ToyMaze-v0.zip", learning_rate=1e-3)
    assert type(agent.parts.walker.learner).__name__ == "OptionTD3" and agent.num_timesteps >= 200


def test_an_unknown_script_says_which_there_are(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["zoo", "dance"])
    with pytest.raises(SystemExit, match="train, enjoy, record_video"):
        zoo.main()
