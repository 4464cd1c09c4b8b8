"""What is in a run's folder: nothing in it, and nobody else, can spoil it."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from conftest import TOY, differences
from filelock import FileLock
from killer import result_of
from test_experiments import plan

from sb3_skillgraph import cli
from sb3_skillgraph.experiments import load_plan, training
from sb3_skillgraph.experiments.run_folder import checkpoints, load_newest, take_checkpoint
from sb3_skillgraph.experiments.runner import compare, status

Capture = pytest.CaptureFixture[str]
COMMAND = ["train", TOY, "--steps", "400", "--env-kwargs", "max_steps=50", "--hyperparams", "learning_starts=100", "--out"]


class Killed(BaseException):
    """What no error handling catches."""


def killed(*_: Any) -> None:
    raise Killed


@pytest.fixture
def stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A run that was killed after 350 steps, with checkpoints at 200 and 300."""
    monkeypatch.setattr(training, "CHECKPOINT_EVERY", 100)
    step = training.Clock._on_step
    with monkeypatch.context() as patch:
        patch.setattr(training.Clock, "_on_step", lambda clock: step(clock) if clock.num_timesteps < 350 else killed())
        with pytest.raises(Killed):
            cli.main([*COMMAND, str(tmp_path / "stopped")])
    assert set(checkpoints(tmp_path / "stopped")) == {200, 300}
    return tmp_path / "stopped"


@pytest.mark.parametrize("file", ["agent.zip", "experience.zip"])
@pytest.mark.parametrize("damage", [lambda file: file.write_bytes(file.read_bytes()[:-50]), Path.unlink], ids=["cut", "gone"])
def test_a_damaged_checkpoint_is_left_out(stopped: Path, tmp_path: Path, capsys: Capture, file: str, damage: Any) -> None:
    damage(stopped / "checkpoint_300" / file)
    with pytest.warns(UserWarning, match="checkpoint_300 cannot be read and is left out"):
        assert cli.main([*COMMAND, str(stopped)]) == 0
    assert "going on after 200 steps" in capsys.readouterr().out
    assert cli.main([*COMMAND, str(tmp_path / "alone")]) == 0
    assert differences(result_of(tmp_path / "alone"), result_of(stopped)) == []


def test_without_a_whole_checkpoint_nothing_is_overwritten(stopped: Path, capsys: Capture) -> None:
    for path in checkpoints(stopped).values():
        (path / "agent.zip").write_text("no agent")
    with pytest.warns(UserWarning, match="left out"):
        assert cli.main([*COMMAND, str(stopped)]) == 2
    assert "None of the checkpoints" in capsys.readouterr().err
    assert set(checkpoints(stopped)) == {200, 300}


def test_what_is_not_the_runs_is_left_alone(stopped: Path) -> None:
    stray = [stopped / name for name in ("checkpoint_best", "checkpoint_100.bak", "notes.partial", ".hidden")]
    for path in stray:
        path.mkdir()
    (stopped / "checkpoint_9").write_text("a file")
    ours = stopped / ".agent.zip.0123abcd.partial"
    ours.write_text("half an agent")
    assert cli.main([*COMMAND, str(stopped)]) == 0
    assert all(path.is_dir() for path in stray) and (stopped / "checkpoint_9").exists()
    assert not ours.exists()


def test_two_commands_do_not_write_one_folder(tmp_path: Path, capsys: Capture) -> None:
    other = FileLock(tmp_path / "lock")
    with other:
        assert cli.main([*COMMAND, str(tmp_path)]) == 2
    assert "another command is at work in" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["lock"]
    assert cli.main([*COMMAND, str(tmp_path)]) == 0


def test_a_run_that_is_done_but_for_its_mark_is_finished(
    stopped: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(training, "discard_all", killed)
        with pytest.raises(Killed):
            cli.main([*COMMAND, str(stopped)])
    assert (stopped / "done.json").exists() and checkpoints(stopped)
    assert cli.main([*COMMAND, str(stopped)]) == 2  # it holds an agent already
    assert not checkpoints(stopped)


def test_a_mark_without_its_agent_is_none(stopped: Path) -> None:
    (stopped / "agent.zip").unlink()
    (stopped / "done.json").write_text("{}")  # of a run before, whose agent was removed
    (stopped / "graph_9.json").write_text("{}")
    assert cli.main([*COMMAND, str(stopped)]) == 0
    assert (stopped / "agent.zip").exists()


def test_what_is_begun_anew_keeps_nothing_of_what_was(tmp_path: Path) -> None:
    (tmp_path / "graph_999.json").write_text("{}")
    (tmp_path / "done.json").write_text("{}")
    assert cli.main([*COMMAND, str(tmp_path)]) == 0
    assert "graph_999.json" not in [path.name for path in tmp_path.iterdir()]


def test_a_finished_run_that_cannot_be_extended_stays_finished(tmp_path: Path, capsys: Capture) -> None:
    assert cli.main([*COMMAND, str(tmp_path)]) == 0
    agent = (tmp_path / "agent.zip").read_bytes()
    (tmp_path / "agent.zip").write_bytes(agent[:-20])
    longer = [*COMMAND[:3], "500", *COMMAND[4:], str(tmp_path)]
    for _ in range(2):
        with pytest.warns(UserWarning, match="left out"):
            assert cli.main(longer) == 2
    assert (tmp_path / "done.json").exists()
    (tmp_path / "agent.zip").write_bytes(agent)
    assert cli.main(longer) == 0
    assert "going on after 400 steps" in capsys.readouterr().out


def test_steps_by_episodes_are_no_more_than_asked_for_and_an_episode(tmp_path: Path) -> None:
    env_kwargs = {"max_steps": 30}
    arguments = {"policy": "MultiInputPolicy", "train_freq": (1, "episode"), "learning_starts": 50}
    agent = training.train(TOY, env_kwargs, arguments, 300, 0, tmp_path)
    assert 300 <= agent.num_timesteps < 330


def test_what_is_stored_by_name_only_is_given_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(training, "CHECKPOINT_EVERY", 100)
    arguments = {"policy": "MultiInputPolicy", "learning_rate": schedule, "learning_starts": 50}
    with monkeypatch.context() as patch:
        patch.setattr(training.Clock, "_on_step", lambda clock: clock.num_timesteps < 250 or killed())
        with pytest.raises(Killed):
            training.train(TOY, {}, arguments, 300, 0, tmp_path)
    assert training.train(TOY, {}, arguments, 300, 0, tmp_path).num_timesteps == 300


def schedule(progress: float) -> float:
    return 1e-3 * progress


def test_two_checkpoints_are_kept(tmp_path: Path) -> None:
    (tmp_path / "checkpoint_5").mkdir()
    for n in (10, 20, 30):
        take_checkpoint(tmp_path, n, lambda folder, n=n: (folder / "number").write_text(str(n)))
    assert set(checkpoints(tmp_path)) == {20, 30}
    assert load_newest(tmp_path, lambda folder: int((folder / "number").read_text())) == (30, 30)
    take_checkpoint(tmp_path, 30, lambda folder: (folder / "number").write_text("again"))
    assert load_newest(tmp_path, lambda folder: (folder / "number").read_text()) == (30, "again")


@pytest.mark.parametrize("name", ["config.json", "progress.csv", "done.json"])
def test_a_damaged_folder_does_not_stop_the_others(tmp_path: Path, name: str) -> None:
    specs = load_plan(plan(tmp_path / "plan.yml", methods={"walk": {"algorithm": "random_walk"}}, seeds=[0, 1, 2]))
    out = tmp_path / "runs"
    assert compare(specs[:1], out) == ["done"]
    (specs[0].folder(out) / name).write_bytes(b"\xff\x00{")
    (specs[1].folder(out)).parent.mkdir(exist_ok=True)
    specs[1].folder(out).write_text("a file where a folder should be")
    with pytest.warns(UserWarning, match="cannot be used"):
        assert compare(specs, out)[1:] == ["failed", "done"]
    states = [run.state for run in status(specs, out)]
    assert states[2] == "done"
    if name != "progress.csv":  # a run that is done is not done again
        assert compare(specs[:1], out) == ["failed"]
        assert f"{name} is damaged" in (specs[0].folder(out) / "error.txt").read_text()


def test_the_umask_is_honoured(tmp_path: Path) -> None:
    code = "import os, sys; os.umask(0o077); from sb3_skillgraph import cli; sys.exit(cli.main(sys.argv[1:]))"
    subprocess.run([sys.executable, "-c", code, *COMMAND, str(tmp_path / "run")], check=True, capture_output=True)
    modes = {path.name: path.stat().st_mode & 0o777 for path in (tmp_path / "run").iterdir()}
    assert all(modes[name] == 0o600 for name in ("agent.zip", "experience.zip", "config.json", "done.json")), modes


def test_a_link_stays_a_link(tmp_path: Path) -> None:
    from sb3_skillgraph.files import write_text

    os.symlink(tmp_path / "there", tmp_path / "here")
    write_text(tmp_path / "here", "text")
    assert (tmp_path / "here").is_symlink() and (tmp_path / "there").read_text() == "text"
