"""Many runs on disk: what is skipped, resumed, refused and reported."""

import importlib
import json
import os
import shutil
import signal
import subprocess
import sys
from collections import Counter
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

import dask
import distributed
import gymnasium as gym
import numpy as np
import pytest
import yaml
from conftest import TOY
from filelock import FileLock
from imageio.v3 import imread

import sb3_skillgraph.envs
from sb3_skillgraph.cli import main
from sb3_skillgraph.experiments import RunSpec, compare, figures, learners, load_plan, run, runner, status, testing
from sb3_skillgraph.experiments.console import commit
from sb3_skillgraph.experiments.figures import method_curves, practice_curves
from sb3_skillgraph.experiments.run_folder import checkpoints, read_progress
from sb3_skillgraph.experiments.summary import estimate, interquartile_mean
from sb3_skillgraph.smdp import SMDPQLearning

SMALL_NETS = {
    "policy_kwargs": {"net_arch": [16, 16]},
    "batch_size": 32,
    "learning_starts": 100,
    "train_freq": 1,
    "exploration_steps": 20,
}


def spec(algorithm: str = "skill_graph", steps: int = 600, **changes: Any) -> RunSpec:
    arguments = SMALL_NETS if algorithm in ("skill_graph", "recipe") else {}
    values: dict[str, Any] = dict(check_every=200, pairs=3, final_pairs=4, arguments=arguments, seed=0, test_pairs=0)
    return RunSpec(algorithm, "toy", algorithm=algorithm, env_id=TOY, steps=steps, **{**values, **changes})


def progress(folder: Path) -> list[dict[str, Any]]:
    return [{name: value for name, value in row.items() if name != "time/seconds"} for row in read_progress(folder)]


def plan(path: Path, **changes: Any) -> Path:
    document = {
        "methods": {"dsg": {"algorithm": "skill_graph", "arguments": SMALL_NETS}, "walk": {"algorithm": "random_walk"}},
        "environments": {"toy": {"id": TOY, "steps": 400}},
        "seeds": [0, 1],
        "check_every": 200,
        "pairs": 2,
        "final_pairs": 3,
        **changes,
    }
    path.write_text(yaml.safe_dump(document, sort_keys=False))
    return path


PLANS = sorted((Path(__file__).parents[1] / "benchmarks").glob("*.yml"))


@pytest.mark.parametrize("file", PLANS, ids=lambda path: path.stem)
def test_the_plans_of_the_benchmarks_can_be_read(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    module, find = importlib.import_module("sb3_skillgraph.experiments.plan"), sb3_skillgraph.envs.find
    # Packages named before a colon need not be installed to test.
    monkeypatch.setattr(module, "find", lambda id: None if ":" in id else find(id))
    assert load_plan(file)


# -- one run ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("algorithm", ["skill_graph", "uvfa", "her", "recipe", "covering_options", "random_walk"])
def test_a_run_leaves_everything_and_is_not_done_again(
    algorithm: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(testing, "STRETCH", 150)
    arguments: dict[str, dict[str, Any]] = {
        "covering_options": {"n_options": 2, "option_updates": 20, "batch_size": 32},
        **{name: {"buffer_size": 2_000} for name in ("uvfa", "her")},  # SB3 saves and loads all of it
    }
    changes = {"arguments": arguments[algorithm]} if algorithm in arguments else {}
    this = spec(algorithm, steps=400, test_pairs=2, test_stretches=1, **changes)
    assert run(this, tmp_path) == "done", (this.folder(tmp_path) / "error.txt").read_text()
    folder = this.folder(tmp_path)
    assert folder == tmp_path / "toy" / algorithm / "seed0"
    config = json.loads((folder / "config.json").read_text())
    assert config["steps"] == 400
    assert config["versions"]["sb3_skillgraph"] and config["versions"]["commit"] == commit()
    assert [row["time/total_timesteps"] for row in progress(folder)] == ([400] if algorithm == "random_walk" else [200, 400])
    saved = checkpoints(folder)[400]
    assert any(saved.iterdir()) == (algorithm != "random_walk")
    if algorithm == "covering_options":
        observation = gym.make(TOY).reset(seed=0)[0]
        model = SMDPQLearning.load(saved / "q_learning.zip")
        seen = {**observation, "action_mask": np.ones(model.action_space.n, dtype=np.int8)}
        assert model.action_space.contains(int(model.predict(seen, deterministic=True)[0]))
    done = json.loads((folder / "done.json").read_text())
    assert len(done["pairs"]) == 4
    assert done["success_rate"] == pytest.approx(sum(pair["success"] for pair in done["pairs"]) / 4)
    assert [len(tests) for tests in done["test_time"]] == [2, 2]
    if algorithm not in ("random_walk", "covering_options"):  # chance walks, or explores, differently the next time
        assert [tests[0] for tests in done["test_time"]] == [pair["success"] for pair in done["pairs"][:2]]
    assert not list(folder.rglob("*.partial"))
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.name != "lock"}
    assert run(this, tmp_path) == "skipped"
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.name != "lock"} == before


class Killed(BaseException):
    """What no error handling catches."""


def test_the_commit_is_known_in_a_checkout_only(monkeypatch: pytest.MonkeyPatch) -> None:
    if (Path(__file__).parents[1] / ".git").exists():
        told = subprocess.run(
            ["git", "rev-parse", "HEAD"], cwd=Path(__file__).parent, capture_output=True, text=True, check=True
        )
        assert commit() and told.stdout.startswith(commit())
    monkeypatch.setenv("PATH", "")  # there is no git
    assert commit() == ""


def test_a_run_goes_on_where_its_checkpoint_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    alone, interrupted = tmp_path / "alone", tmp_path / "interrupted"
    assert run(spec(), alone) == "done"
    take = runner.take_checkpoint

    def killed_before(folder: Path, n_steps: int, save: Any) -> None:
        if n_steps == 400:
            raise Killed
        take(folder, n_steps, save)

    with monkeypatch.context() as patch:
        patch.setattr(runner, "take_checkpoint", killed_before)
        with pytest.raises(Killed):
            run(spec(), interrupted)
    folder = spec().folder(interrupted)
    assert list(checkpoints(folder)) == [200]
    assert len(progress(folder)) == 2  # the row that belongs to no checkpoint is dropped
    (folder / "checkpoint.partial").mkdir()
    (folder / "checkpoint.partial" / "agent.zip").write_text("half")
    assert status([spec()], interrupted)[0].state == "stopped"
    assert run(spec(), interrupted) == "done"
    assert progress(folder) == progress(spec().folder(alone))
    assert list(checkpoints(folder)) == [600]


def test_others_begin_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def killed(policy: Any, spec: RunSpec, n_steps: int) -> Any:
        if n_steps == 400:
            raise Killed
        return test(policy, spec, n_steps)

    test = runner.test_policy
    with monkeypatch.context() as patch:
        patch.setattr(runner, "test_policy", killed)
        with pytest.raises(Killed):
            run(spec("uvfa"), tmp_path)
    assert run(spec("uvfa"), tmp_path) == "done"
    assert [row["time/total_timesteps"] for row in progress(spec("uvfa").folder(tmp_path))] == [200, 400, 600]


def test_an_error_is_kept_and_the_run_tried_again(tmp_path: Path) -> None:
    broken = spec(arguments={"gamma": "much"})
    assert run(broken, tmp_path) == "failed"
    assert "Error" in (broken.folder(tmp_path) / "error.txt").read_text()
    assert status([broken], tmp_path)[0].state == "failed"
    mended = spec()  # nothing had been done with the other settings
    assert run(mended, tmp_path) == "done"
    assert not (mended.folder(tmp_path) / "error.txt").exists()


def test_what_is_done_is_not_taken_for_something_else(tmp_path: Path) -> None:
    assert run(spec("random_walk"), tmp_path) == "done"
    other = spec("random_walk", final_pairs=9)
    assert run(other, tmp_path) == "refused"
    assert not (other.folder(tmp_path) / "error.txt").exists()
    assert status([other], tmp_path)[0].state == "other"
    assert method_curves([other], tmp_path) == {}
    assert status([spec("random_walk")], tmp_path)[0].state == "done"


def test_a_run_with_other_recommended_settings_is_something_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    this = spec()
    assert run(this, tmp_path) == "done"
    config = json.loads((this.folder(tmp_path) / "config.json").read_text())
    assert config["resolved"].items() >= {**this.arguments, "policy": "MultiInputPolicy"}.items()
    load = learners.load_hyperparams
    monkeypatch.setattr(learners, "load_hyperparams", lambda env_id: {**load(env_id), "gamma": 0.5})
    assert run(this, tmp_path) == "refused"


def die_once(spec: RunSpec, out: Path) -> str:
    """Stands in for a run whose worker is killed the first time."""
    folder = spec.folder(out)
    folder.mkdir(parents=True, exist_ok=True)
    if spec.seed == 1 and not (folder / "died").exists():
        (folder / "died").write_text("")
        os.kill(os.getpid(), signal.SIGKILL)
    (folder / "done.json").write_text("{}")
    return "done"


def test_a_killed_worker_does_not_end_the_others_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runner, "run", die_once)
    assert compare([spec(seed=seed) for seed in range(3)], tmp_path, n_jobs=2) == ["done"] * 3


def test_a_run_that_ends_every_worker_is_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tries = []

    class Dying:
        """Stands in for joblib's workers, all of which are killed."""

        def __init__(self, **_: Any) -> None:
            tries.append(self)

        def __call__(self, calls: Any) -> Any:
            raise BrokenProcessPool

    monkeypatch.setattr(runner, "Parallel", Dying)
    with pytest.raises(BrokenProcessPool):
        compare([spec()], tmp_path, n_jobs=2)
    assert len(tries) == 2  # nothing had got any further meanwhile


def test_a_run_that_another_worker_does_is_left_to_it(tmp_path: Path) -> None:
    folder = spec().folder(tmp_path)
    folder.mkdir(parents=True)
    with FileLock(folder / "lock"):
        assert run(spec(), tmp_path) == "elsewhere"
        assert status([spec()], tmp_path)[0].state == "running"
    assert status([spec()], tmp_path)[0].state == "waiting"


# -- many runs --------------------------------------------------------------------------------------------------------


def test_on_loky(tmp_path: Path) -> None:
    specs = load_plan(plan(tmp_path / "plan.yml"))
    assert [(s.method, s.seed) for s in specs] == [("dsg", 0), ("walk", 0), ("dsg", 1), ("walk", 1)]
    assert compare(specs, tmp_path / "runs", n_jobs=2) == ["done"] * 4
    assert compare(specs, tmp_path / "runs", n_jobs=2) == ["skipped"] * 4
    assert {s.state for s in status(specs, tmp_path / "runs")} == {"done"}


def test_an_environment_may_be_tested_otherwise(tmp_path: Path) -> None:
    environments = {"toy": {"id": TOY, "steps": 400}, "long": {"id": TOY, "steps": 800, "check_every": 400, "test_pairs": 1}}
    specs = load_plan(plan(tmp_path / "plan.yml", environments=environments, seeds=[0]))
    toy, long = specs[0], specs[2]
    assert (toy.check_every, toy.test_pairs, toy.pairs) == (200, 0, 2)
    assert (long.check_every, long.test_pairs, long.pairs) == (400, 1, 2)


def test_on_ray(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ray = pytest.importorskip("ray")
    monkeypatch.setenv("RAY_worker_niceness", "0")  # lest its workers starve beside the other tests
    ray.init(num_cpus=1, include_dashboard=False, log_to_driver=False)
    try:
        specs = load_plan(plan(tmp_path / "plan.yml", methods={"walk": {"algorithm": "random_walk"}}))
        assert compare(specs, tmp_path / "runs", n_jobs=1, backend="ray") == ["done"] * 2
    finally:
        ray.shutdown()


def test_on_dask(tmp_path: Path) -> None:
    specs = load_plan(plan(tmp_path / "plan.yml", methods={"walk": {"algorithm": "random_walk"}}))
    assert compare(specs, tmp_path / "runs", n_jobs=1, backend="dask") == ["done"] * 2


def test_on_a_dask_cluster_that_is_there_already(tmp_path: Path) -> None:
    specs = load_plan(plan(tmp_path / "plan.yml", methods={"walk": {"algorithm": "random_walk"}}))
    with (
        distributed.LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None) as cluster,
        dask.config.set({"scheduler-address": cluster.scheduler_address}),
    ):
        assert compare(specs, tmp_path / "runs", n_jobs=2, backend="dask") == ["done"] * 2


WORKERS = """
import json, os, signal, sys
from pathlib import Path
from sb3_skillgraph.agent import SkillGraphAgent
from sb3_skillgraph.experiments import compare, load_plan, runner

plan, out, rounds = Path(sys.argv[1]), Path(sys.argv[2]), json.loads(sys.argv[3])

def work(turn, place, left):
    def killed_in_time(call):
        def counted(*arguments, **kwargs):
            nonlocal left
            left -= 1
            if left == 0:
                os.kill(os.getpid(), signal.SIGKILL)
            return call(*arguments, **kwargs)
        return counted

    owner, name = {
        "step": (SkillGraphAgent, "_store_transition"),
        "test": (SkillGraphAgent, "act"),
        "write": (os, "fsync"),
        "save": (SkillGraphAgent, "save_replay_buffer"),
    }[place]
    setattr(owner, name, killed_in_time(getattr(owner, name)))
    do = runner._Run.do

    def noted(self):
        with (out / "begun.txt").open("a") as file:
            file.write(f"{turn} {self.folder.name}\\n")
        do(self)

    runner._Run.do = noted
    compare(load_plan(plan), out)

ends = []
for turn, workers in enumerate(rounds):  # those of one round at the same time
    begun = []
    for worker in workers:
        begun.append(os.fork())
        if begun[-1] == 0:
            try:
                work(turn, *worker)
                os._exit(0)
            finally:
                os._exit(1)
    ends.append([os.waitstatus_to_exitcode(os.waitpid(worker, 0)[1]) for worker in begun])
print(json.dumps(ends))
"""


def work(plan_file: Path, out: Path, rounds: list[list[tuple[str, int]]]) -> list[list[int]]:
    """Let workers do a plan that are killed at the n-th call of something, never for 0; return how they ended."""
    command = [sys.executable, "-c", WORKERS, str(plan_file), str(out), json.dumps(rounds)]
    done = subprocess.run(command, env={**os.environ, "OMP_NUM_THREADS": "1"}, check=True, stdout=subprocess.PIPE, text=True)
    ends: list[list[int]] = json.loads(done.stdout.splitlines()[-1])
    return ends


def test_killed_at_any_moment_it_comes_to_the_same_and_two_workers_share(tmp_path: Path) -> None:
    methods = {"dsg": {"algorithm": "skill_graph", "arguments": SMALL_NETS}}
    toy = {"id": TOY, "steps": 500, "kwargs": {"max_steps": 60}}
    file = plan(tmp_path / "plan.yml", methods=methods, environments={"toy": toy}, check_every=100)
    specs, alone, shared = load_plan(file), tmp_path / "alone", tmp_path / "shared"
    compare(specs, alone)
    shared.mkdir()
    steps = np.random.default_rng(0).integers(120, 300, 3).tolist()
    deaths = [*(("step", n) for n in steps), ("write", 2), ("save", 2), ("test", 90)]
    rounds = [*([death] for death in deaths), [("step", 0), ("step", 0)]]
    assert work(file, shared, rounds) == [[-signal.SIGKILL]] * len(deaths) + [[0, 0]]
    lines = [line.split() for line in (shared / "begun.txt").read_text().splitlines()]
    assert {int(turn) for turn, _ in lines} == set(range(len(rounds)))
    last = [name for turn, name in lines if int(turn) == len(deaths)]
    assert len(set(last)) == len(last)  # each by one of the two
    for s in specs:
        assert (s.folder(shared) / "done.json").exists()
        assert not (s.folder(shared) / "error.txt").exists()
        assert progress(s.folder(shared)) == progress(s.folder(alone))


@pytest.mark.parametrize("n_workers", [2, 4])
def test_workers_share_what_one_of_them_leaves_and_none_minds_a_damaged_folder(tmp_path: Path, n_workers: int) -> None:
    methods = {"dsg": {"algorithm": "skill_graph", "arguments": SMALL_NETS}}
    toy = {"id": TOY, "steps": 300, "kwargs": {"max_steps": 60}}
    file = plan(tmp_path / "plan.yml", methods=methods, environments={"toy": toy}, check_every=100, seeds=[0, 1, 2, 3, 4])
    specs, out = load_plan(file), tmp_path / "shared"
    damaged = specs[2].folder(out)
    damaged.mkdir(parents=True)
    (damaged / "progress.csv").write_text("half a li")
    (damaged / "config.json").write_text("")
    ends = work(file, out, [[("step", 150), *[("step", 0)] * (n_workers - 1)]])
    assert ends == [[-signal.SIGKILL, *[0] * (n_workers - 1)]]
    begun = Counter(line.split()[1] for line in (out / "begun.txt").read_text().splitlines())
    assert sorted(begun.values()) == [1, 1, 1, 2]  # the one that was killed, twice
    for s in specs:
        assert (s.folder(out) / "done.json").exists() == (s.folder(out) != damaged)
    assert "config.json is damaged" in (damaged / "error.txt").read_text()
    assert Counter(run.state for run in status(specs, out)) == {"done": 4, "failed": 1}


#: A maze, but none of ours.
FOREIGN = {"theirs": {"id": "PointMaze_UMaze-v3", "steps": 400}}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"methods": {"dsg": {"algorithm": "skil_graph"}}}, "unknown algorithm 'skil_graph'.*'skill_graph'"),
        ({"methods": {"dsg": {"algorithm": "skill_graph", "arguments": {"gama": 1}}}}, "unknown argument 'gama'"),
        ({"methods": {"flat": {"algorithm": "recipe", "arguments": {"gama": 1}}}}, "unknown argument 'gama'"),
        ({"methods": {"flat": {"algorithm": "recipe"}}, "environments": FOREIGN}, "'recipe' is for SkillGraph/. mazes"),
        ({"methods": {"dco": {"algorithm": "covering_options"}}, "environments": FOREIGN}, "for SkillGraph/. mazes"),
        ({"environments": FOREIGN, "test_pairs": 1}, "test_pairs is for SkillGraph/. mazes, not for PointMaze_UMaze-v3"),
        ({"methods": {}}, "methods is missing"),
        ({"seeds": 3}, "seeds must be a list, not 3"),
        ({"check_every": 0}, "check_every must be a positive number, not 0"),
        ({"sedes": [1]}, "unknown entry 'sedes'"),
        ({"environments": {"toy": {"id": TOY}}}, "environment 'toy': steps is missing"),
        ({"environments": {"toy": {"id": TOY, "steps": 5, "methods": ["dgs"]}}}, "unknown method 'dgs'"),
        ({"environments": ["toy"]}, "environments must be a mapping"),
        (
            {"methods": {"flat": {"algorithm": "uvfa", "arguments": {"goal_frq": 1}}}},
            "unknown argument 'goal_frq'.*'goal_freq'",
        ),
        ({"methods": {"dco": {"algorithm": "covering_options", "arguments": {"options": 1}}}}, "unknown argument 'options'"),
        ({"methods": {"walk": {"algorithm": "random_walk", "arguments": {"steps": 1}}}}, "unknown argument 'steps'"),
        (
            {"methods": {"walk": {"algorithm": "random_walk", "also": {"x": {"algorithm": "straight_on"}}}}},
            "only what a skill_graph",
        ),
        (
            {"methods": {"dsg": {"algorithm": "skill_graph", "also": {"x": {"algorithm": "straight"}}}}},
            "unknown algorithm 'straight'",
        ),
        (
            {
                "methods": {
                    "d": {"algorithm": "skill_graph", "also": {"x": {"algorithm": "replay_search", "arguments": {"n": 3}}}}
                }
            },
            "'x': unknown argument 'n'",
        ),
        ({"methods": {"walk": {"algorithm": "random_walk", "seeds": [-1]}}}, "a seed must be a whole number"),
        ({"methods": {False: {"algorithm": "random_walk"}}}, "False is no name"),
        ({"methods": {"../walk": {"algorithm": "random_walk"}}}, "'../walk' is no name"),
        ({"environments": {"toy": {"id": "SkillGraph/TyoMaze-v0", "steps": 5}}}, "environment 'toy': .*TyoMaze"),
        ({"environments": {"toy": {"id": TOY, "steps": 5, "methods": [3]}}}, "unknown method 3"),
        ({"seeds": [0, 0]}, "a seed stands twice"),
        ({"seeds": ["a"]}, "a seed must be a whole number, 0 or more, not 'a'"),
    ],
)
def test_what_a_plan_must_not_say(changes: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=message):
        load_plan(plan(tmp_path / "plan.yml", **changes))


def test_a_plan_that_is_no_yaml(tmp_path: Path) -> None:
    (tmp_path / "plan.yml").write_text("methods: [")
    with pytest.raises(ValueError, match="no valid YAML"):
        load_plan(tmp_path / "plan.yml")


@pytest.mark.parametrize(
    ("backend", "module", "package"), [("ray", "ray.util.joblib", "ray"), ("dask",) + ("distributed",) * 2]
)
def test_an_unknown_backend_says_what_to_install(
    backend: str, module: str, package: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ValueError, match=f"pip install {package}"):
        compare([], tmp_path, backend=backend)


# -- estimates and figures --------------------------------------------------------------------------------------------


def test_interquartile_mean_and_its_interval() -> None:
    assert interquartile_mean(np.array([0.0, 0.4, 0.6, 1.0])) == pytest.approx(0.5)
    scores = np.random.default_rng(0).normal(0.5, 0.1, (3, 40))
    mean, low, high = estimate(scores)
    assert mean == interquartile_mean(scores)
    assert low < mean < high
    assert 0.02 < high - low < 0.08
    assert estimate(np.full((2, 5), 0.7)) == pytest.approx((0.7, 0.7, 0.7))
    # Strata: an environment where all seeds agree adds no uncertainty, whatever its level.
    one, both = estimate(scores[:1]), estimate(np.stack([scores[0], np.full(40, 0.5)]))
    assert both.high - both.low < one.high - one.low


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("compare")
    methods = {
        "frontier": {"algorithm": "skill_graph", "arguments": SMALL_NETS},
        "dco": {"algorithm": "skill_graph", "arguments": {**SMALL_NETS, "salience": "dco"}},
        "walk": {"algorithm": "random_walk"},
    }
    toy = {"toy": {"id": TOY, "steps": 1200}}
    file = plan(
        folder / "plan.yml", methods=methods, environments=toy, seeds=[1], check_every=400, test_pairs=1, test_stretches=1
    )
    assert compare(load_plan(file), folder / "runs", n_jobs=2) == ["done"] * 3
    return file, folder / "runs"


@pytest.mark.parametrize("number", [3, 4, 5, 6, 9])
def test_figures_of_the_paper(number: int, runs: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(figures, "N_PAIRS", 1_000)
    monkeypatch.setattr(figures, "SHARES", (0.5, 1.0))
    file, out = runs
    picture = tmp_path / "figure.png"
    assert main(["figure", str(number), str(file), "--out", str(out), "--to", str(picture)]) == 0
    image = imread(picture)
    assert image.shape[0] > 300
    assert image[..., :3].std() > 10


def test_curves_are_the_seeds_rows(runs: tuple[Path, Path]) -> None:
    specs = load_plan(runs[0])
    curves = method_curves(specs, runs[1])
    assert list(curves) == ["frontier", "dco", "walk"]
    rows = read_progress(specs[0].folder(runs[1]))
    assert curves["frontier"].steps.tolist() == [400, 800, 1200]
    same = [pair["success"] for pair in json.loads((specs[0].folder(runs[1]) / "done.json").read_text())["pairs"][:2]]
    expected = [*(float(row["eval/success_rate"]) for row in rows[:-1]), np.mean(same)]
    assert curves["frontier"].mean.tolist() == pytest.approx(expected)
    assert curves["walk"].steps.tolist() == [0, 1200]
    tested = practice_curves(specs, runs[1])
    assert list(tested) == ["frontier", "dco", "walk"]
    assert all(curve.steps.tolist() == [0, 1000] for curve in tested.values())


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["figure", "2"], "no Figure 2"),
        (["figure", "7"], "no Figure 7"),  # it shows edges between skills
        (["figure", "8"], "no Figure 8"),
        (["figure", "5", "--method", "frontire"], "no method 'frontire'; it has frontier, dco, walk"),
        (["figure", "3", "--method", "walk"], "needs a finished run of a skill graph"),
        (["figure", "9", "--method", "frontier"], "with salience=dco"),
    ],
)
def test_what_cannot_be_drawn(
    words: list[str], message: str, runs: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = [*words[:2], str(runs[0]), *words[2:], "--out", str(runs[1]), "--to", str(tmp_path / "x.png")]
    assert main(command) == 2
    assert message in capsys.readouterr().err


def test_stored_results_without_agents_say_so(
    runs: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(runs[1], tmp_path / "results", ignore=shutil.ignore_patterns("checkpoint_*"))
    command = [str(runs[0]), "--out", str(tmp_path / "results"), "--to", str(tmp_path / "x.png")]
    assert main(["figure", "6", *command]) == 0
    assert main(["figure", "3", *command]) == 2
    assert "no finished run of a skill graph" in capsys.readouterr().err


def test_compare_and_status_on_the_command_line(runs: tuple[Path, Path], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["compare", str(runs[0]), "--out", str(runs[1])]) == 0
    assert "3 skipped" in capsys.readouterr().out
    assert main(["status", str(runs[0]), "--out", str(runs[1])]) == 0
    assert "1/1" in capsys.readouterr().out
    assert main(["status", "nowhere.yml", "--out", str(runs[1])]) == 2
    assert "there is no plan nowhere.yml" in capsys.readouterr().err


# -- what a plan tests ------------------------------------------------------------------------------------------------


def test_other_ways_to_act_are_tested_at_the_end_on_the_same_pairs(tmp_path: Path) -> None:
    rivals = {
        "straight": {"algorithm": "straight_on"},
        "search": {"algorithm": "replay_search", "arguments": {"n_states": 50}},
    }
    this = spec(steps=400, also=rivals)
    assert run(this, tmp_path) == "done", (this.folder(tmp_path) / "error.txt").read_text()
    done = json.loads((this.folder(tmp_path) / "done.json").read_text())
    assert list(done["also"]) == ["straight", "search"]
    for test in done["also"].values():
        assert [pair["goal"] for pair in test["pairs"]] == [pair["goal"] for pair in done["pairs"]]
        assert "promised" not in test["pairs"][0] and 0.0 < done["pairs"][0]["promised"] <= 1.0


def test_every_test_is_kept_pair_by_pair_under_its_own_conditions(tmp_path: Path) -> None:
    this = spec(steps=400, test_kwargs={"max_steps": 30})
    assert run(this, tmp_path) == "done"
    folder = this.folder(tmp_path)
    for row, n_pairs in zip(read_progress(folder), (3, 4), strict=True):
        test = json.loads((folder / f"test_{row['time/total_timesteps']}.json").read_text())
        assert len(test["pairs"]) == n_pairs and max(pair["steps"] for pair in test["pairs"]) <= 30
        assert test["success_rate"] == float(row["eval/success_rate"])


@pytest.mark.mujoco
def test_the_tasks_of_an_environment_are_done(tmp_path: Path) -> None:
    pytest.importorskip("ogbench")
    giant = {"env_id": "SkillGraph/OGBenchPointMedium-v0", "env_kwargs": {"random_start": True, "max_steps": 20}}
    this = RunSpec(
        "walk", "giant", 0, "random_walk", steps=100, check_every=100, pairs=2, final_pairs=2, task_episodes=2, **giant
    )
    assert run(this, tmp_path) == "done", (this.folder(tmp_path) / "error.txt").read_text()
    done = json.loads((this.folder(tmp_path) / "done.json").read_text())
    assert [len(task) for task in done["tasks"]] == [2] * 5
    assert "eval/task_success_rate" in read_progress(this.folder(tmp_path))[0]
    starts = np.array([episode["start"] for episode in done["tasks"][0]])
    assert (starts[0] != starts[1]).any() and np.ptp(starts, axis=0).max() <= 2.0
