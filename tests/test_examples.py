"""The examples run as they are, with fewer steps; so do the benchmarks that nothing else runs."""

import importlib
import json
import re
import runpy
import sys
from pathlib import Path

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from conftest import TOY

from sb3_skillgraph import SkillGraphAgent

Capture = pytest.CaptureFixture[str]
EXAMPLES = Path(__file__).parent.parent / "examples"


def run(monkeypatch: pytest.MonkeyPatch, name: str, *arguments: object) -> None:
    monkeypatch.setattr(sys, "argv", [name, *map(str, arguments)])
    runpy.run_path(str(EXAMPLES / name), run_name="__main__")


def test_quickstart(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: Capture) -> None:
    run(monkeypatch, "quickstart.py", "--env", TOY, "--steps", 300, "--out", tmp_path / "new")
    printed = capsys.readouterr().out
    assert "The goal lies" in printed and "go there" in printed
    assert "reached the goal" in printed or "did not reach the goal" in printed
    assert {path.name for path in (tmp_path / "new").iterdir()} == {"agent.zip", "skill_graph.png", "plan.png"}


def test_own_environment(monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    run(monkeypatch, "own_environment.py", "--steps", 300)
    printed = capsys.readouterr().out
    assert " events, " in printed and " edges" in printed
    assert re.search(r"success rate: [01]\.\d\d", printed)


def test_the_notebook_runs_and_shows_what_it_showed(monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    notebook = json.loads((EXAMPLES / "looking.ipynb").read_text())
    monkeypatch.chdir(EXAMPLES)
    names: dict[str, object] = {}
    for cell in notebook["cells"]:
        if cell["cell_type"] != "code":
            continue
        lines = [line for line in cell["source"] if not line.startswith("%")]  # Jupyter's own commands
        exec("".join(lines), names)
        shown = "".join(line for output in cell["outputs"] for line in output.get("text", []))
        assert capsys.readouterr().out == shown


class Darkness:
    """Renders without a screen, and without OpenGL."""

    n_frames = 0

    def __init__(self, model: mujoco.MjModel, height: int, width: int) -> None:
        self.shape = (height, width, 3)

    def update_scene(self, data: mujoco.MjData, camera: mujoco.MjvCamera) -> None:
        pass

    def render(self) -> np.ndarray:
        Darkness.n_frames += 1
        return np.zeros(self.shape, dtype=np.uint8)


@pytest.mark.mujoco
def test_ant_to_any_goal(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: Capture) -> None:
    monkeypatch.setattr(mujoco, "Renderer", Darkness)
    agent = SkillGraphAgent("MultiInputPolicy", gym.make("SkillGraph/AntUMaze-v0"), seed=0)
    agent.save(tmp_path / "agent.zip")
    goals = ["--goal", "-3.9", "4.1", "--goal", "-4", "-4"]  # at the start, and far away
    more = ["--out", tmp_path / "out", "--env-kwargs", "torque=30"]
    run(monkeypatch, "ant_to_any_goal.py", tmp_path / "agent.zip", *goals, *more)
    out = capsys.readouterr().out
    assert "goal [-3.9, 4.1]: " in out and "steps, reached" in out
    assert "goal [-4.0, -4.0]: outside, " in out
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"way_0.png", "way_1.png", "ant.gif", "ant.png"}
    assert Darkness.n_frames > 10
    with pytest.raises(SystemExit):
        run(monkeypatch, "ant_to_any_goal.py", tmp_path / "agent.zip", "--goal", 0, 0)
    assert "reset option 'goal' is" in capsys.readouterr().err


# -- benchmarks -------------------------------------------------------------------------------------------------------

ROOT = EXAMPLES.parent
BENCHMARKS = sorted(path.stem for path in (ROOT / "benchmarks").glob("*.py") if "def main" in path.read_text())


@pytest.mark.parametrize("name", BENCHMARKS)
def test_a_benchmark_can_be_imported(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT))
    assert callable(importlib.import_module(f"benchmarks.{name}").main)


@pytest.mark.mujoco
def test_throughput_tells_the_parts_of_a_step(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT))
    throughput = importlib.import_module("benchmarks.throughput")
    row = throughput.measure(throughput.Case("point", (16, 16), 16, 1), 300, 40, 1)
    assert row["events"] >= 1
    for times in (row["sb3"], row["ours"]):
        assert times["total"] == pytest.approx(sum(times[part] for part in throughput.PARTS), abs=1e-3)
        assert min(times.values()) > 0.0
