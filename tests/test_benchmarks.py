"""What the benchmarks make of finished runs: tables, and the page of results."""

import importlib
import math
import shutil
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import yaml
from conftest import TOY

from sb3_skillgraph.experiments import compare, load_plan
from sb3_skillgraph.experiments.run_folder import DONE, read_json

ROOT = Path(__file__).parents[1]
SMALL_NETS = {"policy_kwargs": {"net_arch": [16, 16]}, "batch_size": 32, "learning_starts": 100}


@pytest.fixture(autouse=True)
def _at_the_root(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT))


def module(name: str) -> Any:
    return importlib.import_module(f"benchmarks.{name}")


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A plan whose runs are done: two methods, two seeds, one more way to act."""
    folder = tmp_path_factory.mktemp("runs")
    also = {"straight-on": {"algorithm": "straight_on"}}
    document = {
        "methods": {
            "dsg": {"algorithm": "skill_graph", "arguments": SMALL_NETS, "also": also},
            "walk": {"algorithm": "random_walk", "seeds": [0]},
        },
        "environments": {"toy": {"id": TOY, "steps": 300, "test_kwargs": {"max_steps": 40}}},
        "seeds": [0, 1],
        "check_every": 150,
        "pairs": 3,
        "final_pairs": 5,
    }
    plan = folder / "toy.yml"
    plan.write_text(yaml.safe_dump(document, sort_keys=False))
    specs = load_plan(plan)
    assert [(spec.method, spec.seed) for spec in specs] == [("dsg", 0), ("walk", 0), ("dsg", 1)]
    assert compare(specs, folder / "out", n_jobs=2) == ["done"] * 3
    return plan, folder / "out"


def test_the_tables_hold_what_the_runs_say(finished: tuple[Path, Path], tmp_path: Path) -> None:
    collect = module("collect")
    summary = collect.collect(*finished, tmp_path)
    runs = collect.read(tmp_path / "runs.csv")
    assert {(row["method"], row["seed"]) for row in runs} == {
        ("dsg", 0),
        ("dsg", 1),
        ("straight-on", 0),
        ("straight-on", 1),
        ("walk", 0),
    }
    for spec in load_plan(finished[0]):
        done = read_json(spec.folder(finished[1]) / DONE)
        row = next(row for row in runs if (row["method"], row["seed"]) == (spec.method, spec.seed))
        assert row["success_rate"] == pytest.approx(done["success_rate"]) and row["pairs"] == 5
        assert all(pair["steps"] <= 40 for pair in done["pairs"]), "tests have their own keyword arguments"
        for name, test in done["also"].items():
            other = next(row for row in runs if (row["method"], row["seed"]) == (name, spec.seed))
            assert other["success_rate"] == pytest.approx(test["success_rate"])
    curves = collect.read(tmp_path / "curves.csv")
    assert [row["steps"] for row in curves if row["method"] == "dsg"] == [150, 300, 150, 300]
    promises = collect.read(tmp_path / "promises.csv")
    assert sum(row["n_plans"] for row in promises) == 2 * (3 + 5), "every plan of every test is in one bin"
    assert [row["mean"] for row in summary] == sorted((row["mean"] for row in summary), reverse=True)
    mine = next(row for row in summary if row["method"] == "dsg")
    assert mine["seeds"] == 2 and math.isnan(mine["difference"])
    assert "benchmarks.collect" in (tmp_path / "command.txt").read_text()


def test_collecting_again_changes_nothing_and_keeps_what_is_gone(finished: tuple[Path, Path], tmp_path: Path) -> None:
    collect = module("collect")
    collect.collect(*finished, tmp_path)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    collect.collect(*finished, tmp_path)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before
    fewer = tmp_path / "fewer"
    shutil.copytree(finished[1], fewer)
    shutil.rmtree(fewer / "toy" / "dsg" / "seed1")
    collect.collect(finished[0], fewer, tmp_path)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir() if path.is_file()} == before


@pytest.mark.parametrize("commit", ["72e3967", "0123456", "1234567", "nan"])
def test_a_commit_that_looks_like_a_number_stays_one(commit: str, tmp_path: Path) -> None:
    collect = module("collect")
    rows = [{"environment": "toy", "method": "dsg", "seed": 3, "success_rate": 0.5, "version": "0.2", "commit": commit}]
    collect.write(tmp_path / "runs.csv", rows)
    assert collect.read(tmp_path / "runs.csv") == rows


def test_intervals_are_paired_by_seeds() -> None:
    collect = module("collect")
    rates = {"a": [0.9, 0.5, 0.7, 0.8, 0.6], "b": [0.8, 0.4, 0.6, 0.7, 0.5]}
    runs = [
        {**dict.fromkeys(("task_success_rate", "steps_to_goals", "steps_over_first", "times_shortest"), math.nan), "falls": 0}
        | {"environment": "toy", "method": name, "seed": seed, "steps": 10, "success_rate": value, "seconds": 1.0}
        for name, values in rates.items()
        for seed, value in enumerate(values)
    ]
    rows = {row["method"]: row for row in collect.summarise(runs, ["toy"], "a")}
    assert rows["b"]["difference"] == pytest.approx(-0.1)
    assert (rows["b"]["difference_low"], rows["b"]["difference_high"]) == pytest.approx((-0.1, -0.1)), (
        "each seed loses as much"
    )
    assert rows["a"]["low"] < 0.7 < rows["a"]["high"]
    assert collect.interval([0.5], (0.0, 1.0))[0] == 0.5 and math.isnan(collect.interval([0.5], (0.0, 1.0))[1])
    low, high = collect.interval([0.9, 1.0, 1.0], (0.0, 1.0))[1:]
    assert 0.8 < low < 0.9 and high == 1.0, "a rate is no more than 1"


def test_the_page_of_results_is_what_the_tables_say(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    report = module("report")
    readme = tmp_path / "README.md"
    shutil.copy(ROOT / "README.md", readme)
    monkeypatch.setattr(report, "PAGE", tmp_path / "results.md")
    monkeypatch.setattr(report, "README", readme)
    report.main()
    assert (tmp_path / "results.md").read_text() == (ROOT / "docs" / "results.md").read_text()
    assert readme.read_text() == (ROOT / "README.md").read_text()


def test_the_picture_of_learning_shows_every_method_and_its_seeds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pictures, collect = module("pictures"), module("collect")
    drawn = {}
    monkeypatch.setattr(pictures, "PAGE", tmp_path / "results.md")
    monkeypatch.setattr(pictures, "plot_curves", lambda axes, curves, methods, title: drawn.update({title: curves}))
    pictures.main()
    assert (tmp_path / "learning_curves.png").stat().st_size > 0
    assert tuple(next(iter(drawn.values()))) == pictures.METHODS
    rows = collect.read(collect.RESULTS / "paper" / "curves.csv")
    ends = [row["success_rate"] for row in rows if row["method"] == "paper-rrt" and row["steps"] == 300_000]
    curve = next(iter(drawn.values()))["paper-rrt"]
    assert curve.steps[-1] == 300_000
    np.testing.assert_allclose([curve.low[-1], curve.mean[-1], curve.high[-1]], [min(ends), np.mean(ends), max(ends)])


@pytest.mark.parametrize(
    ("low", "high", "told"), [(0.1, 0.3, "told apart"), (-0.3, -0.1, "told apart"), (-0.1, 0.1, "not told apart")]
)
def test_methods_are_told_apart_by_their_interval(low: float, high: float, told: str) -> None:
    text = module("report").verdict({"difference": 0.2, "difference_low": low, "difference_high": high})
    assert text.endswith(f", {told}")


def test_the_results_are_few_files() -> None:
    assert sum(path.is_file() for path in (ROOT / "benchmarks" / "results").rglob("*")) <= 120


@pytest.mark.mujoco
def test_the_shortest_way_in_a_maze_is_as_long_as_it_looks() -> None:
    pytest.importorskip("ogbench")
    env = gym.make("SkillGraph/OGBenchPointMedium-v0")
    geometry = env.get_wrapper_attr("geometry")
    shortest = module("shortest").Shortest(geometry, 1.0)
    start = geometry.cell_to_xy(*geometry.start_cell)
    assert shortest(start, start) == 0
    ahead = next(cell for cell in ([4.0, 0.0], [0.0, 4.0]) if geometry.is_free(start + np.array(cell), 0.7))
    assert shortest(start, start + np.array(ahead)) == pytest.approx((4.0 - 1.0) / 0.2, abs=1)
    env.close()
