"""Doing runs: what is done is skipped, what was killed is resumed, and no run is done twice at a time."""

import csv
import io
import json
import time
import traceback
import warnings
from collections.abc import Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any, Literal, NamedTuple

import gymnasium as gym
import numpy as np
import torch as th
from filelock import FileLock, Timeout
from joblib import Parallel, delayed, parallel_config

from sb3_skillgraph.evaluation import PairsResult, evaluate_pairs, run_pair
from sb3_skillgraph.experiments.console import versions
from sb3_skillgraph.experiments.learners import ALGORITHMS, Learner
from sb3_skillgraph.experiments.plan import RunSpec
from sb3_skillgraph.experiments.run_folder import (
    CONFIG,
    DONE,
    LOCK,
    PROGRESS,
    STEPS,
    checkpoints,
    claimed,
    discard,
    discard_all,
    load_newest,
    read_json,
    read_progress,
    take_checkpoint,
)
from sb3_skillgraph.experiments.training import plain
from sb3_skillgraph.files import write_text

ERROR = "error.txt"
SECONDS = "time/seconds"
STRETCH = 1_000  # environment steps between tests at test time: an episode
Outcome = Literal["done", "skipped", "elsewhere", "failed", "refused"]


class RunStatus(NamedTuple):
    """How a run stands.

    :param spec: the run
    :param state: ``done``, ``running``, ``failed``, ``stopped`` (to be resumed), ``waiting``, or ``other`` where the folder
        holds a run with other settings
    :param steps: environment steps done, those that will not have to be done again
    :param seconds_left: estimate, without tests; None before the first check
    :param success_rate: last measured; None before the first check
    """

    spec: RunSpec
    state: Literal["done", "running", "failed", "stopped", "waiting", "other"]
    steps: int
    seconds_left: float | None
    success_rate: float | None


def compare(specs: Sequence[RunSpec], out: Path, n_jobs: int = 1, backend: str = "loky") -> list[Outcome]:
    """Do runs.

    :param specs: the runs
    :param out: folder for all of them; other workers may be at work in it
    :param n_jobs: runs at a time
    :param backend: joblib's: ``loky``, ``ray`` or ``dask``, which bring their own clusters; Dask's is that of the current
        client or of Dask's configuration, else one on this machine
    :return: what became of each
    :raises ValueError: if the backend is not installed
    """
    with _engine(backend, n_jobs), parallel_config(backend=backend, n_jobs=n_jobs):
        outcomes = _do(specs, out)
        # Whoever was at work elsewhere may have been killed meanwhile.
        left = [i for i, outcome in enumerate(outcomes) if outcome == "elsewhere"]
        for i, outcome in zip(left, _do([specs[i] for i in left], out), strict=True):
            outcomes[i] = "done" if outcome == "skipped" else outcome
    return outcomes


def _do(specs: Sequence[RunSpec], out: Path) -> list[Outcome]:
    furthest = -1
    while True:
        try:
            return list(Parallel(batch_size=1, pre_dispatch="n_jobs")(delayed(run)(spec, out) for spec in specs))
        except BrokenProcessPool:
            # A worker was killed, and joblib has ended the others: go on, unless nothing gets any further.
            reached = sum(each.steps + (each.state == "done") for each in status(specs, out))
            if reached <= furthest:
                raise
            furthest = reached


def _engine(backend: str, n_jobs: int) -> AbstractContextManager[Any]:
    """Get joblib's backend ready: Ray's registers itself, Dask's wants a client while it is used."""
    try:
        if backend == "ray":
            from ray.util.joblib import register_ray  # type: ignore[import-not-found, unused-ignore]

            register_ray()
        if backend == "dask":
            return _dask_client(n_jobs)
    except ImportError as error:
        package = {"ray": "ray", "dask": "distributed"}[backend]
        raise ValueError(f"The backend {backend} needs its package: pip install {package}.") from error
    return nullcontext()


def _dask_client(n_jobs: int) -> AbstractContextManager[Any]:
    import dask  # type: ignore[import-not-found, unused-ignore]
    from distributed import Client, get_client  # type: ignore[import-not-found, unused-ignore]

    try:
        return nullcontext(get_client())
    except ValueError:
        # Of the scheduler that Dask's configuration names, or of this machine; runs must not share their generators.
        named = dask.config.get("scheduler-address", None) is not None
        here: dict[str, Any] = dict(n_workers=n_jobs, threads_per_worker=1, dashboard_address=None)
        client: AbstractContextManager[Any] = Client(**({} if named else here))
        return client


def is_done(spec: RunSpec, out: Path) -> bool:
    """Tell whether a run is finished; one with other settings that lies in its place does not count.

    :param spec: the run
    :param out: folder for all runs
    """
    return (spec.folder(out) / DONE).exists() and not has_other_settings(spec, out)


def has_other_settings(spec: RunSpec, out: Path) -> bool:
    """Tell whether something has been done in a run's place with other settings.

    :param spec: the run
    :param out: folder for all runs
    """
    folder = spec.folder(out)
    begun = (folder / DONE).exists() or (folder / PROGRESS).exists() or bool(checkpoints(folder))
    if not begun or not (folder / CONFIG).exists():
        return False
    before = read_json(folder / CONFIG)
    before.pop("versions", None)
    now = json.loads(_settings(spec))
    return bool(before != now)


def _settings(spec: RunSpec) -> str:
    """Return all that is set as JSON: what the plan says, and what is recommended where it is silent."""
    resolved = ALGORITHMS[spec.algorithm].resolve(spec.env_id, spec.arguments)
    return json.dumps({**spec.as_plain(), "resolved": resolved}, default=plain)


def run(spec: RunSpec, out: Path) -> Outcome:
    """Do one run, from its last checkpoint if there is one; an error is written into its folder.

    What has been done there with other settings is left alone, and the run refused.

    :param spec: the run
    :param out: folder for all runs
    """
    th.set_num_threads(1)
    folder = spec.folder(out)
    try:
        with claimed(folder):
            try:
                if has_other_settings(spec, out):
                    return "refused"
                if (folder / DONE).exists():
                    read_json(folder / DONE)  # or it is damaged
                    return "skipped"
                _Run(spec, folder).do()
            except Exception:
                write_text(folder / ERROR, traceback.format_exc())
                return "failed"
            return "done"
    except Timeout:
        return "elsewhere"
    except OSError as error:
        warnings.warn(f"{folder} cannot be used: {error}", stacklevel=2)
        return "failed"


class _Run:
    def __init__(self, spec: RunSpec, folder: Path) -> None:
        self.spec = spec
        self.folder = folder
        self.result: PairsResult | None = None
        self.rows: list[dict[str, Any]] = []
        self.seconds = 0.0
        self._clock = 0.0

    def do(self) -> None:
        spec, folder = self.spec, self.folder
        (folder / ERROR).unlink(missing_ok=True)
        self.learner = ALGORITHMS[spec.algorithm](spec.env_id, spec.env_kwargs, spec.seed, spec.arguments)
        begin = self._resume(self.learner)
        if not begin:
            document = {**json.loads(_settings(spec)), "versions": versions()}
            write_text(folder / CONFIG, json.dumps(document, indent=1) + "\n")
        self._clock = time.perf_counter()
        if begin < spec.steps:
            self.learner.learn(begin, spec.steps, spec.check_every, self._check)
        result = self.result or self._test(spec.steps)
        document = {
            "success_rate": result.success_rate,
            "interval": result.interval,
            "seconds": round(self.seconds, 1),
            "pairs": [
                {
                    "start": p.start.round(3).tolist(),
                    "goal": p.goal.round(3).tolist(),
                    "path_length": round(p.path_length, 3),
                    "success": bool(p.success),
                    "steps": p.steps,
                    "nearest": round(p.nearest, 4),
                    "stuck": p.stuck,
                }
                for p in result.pairs
            ],
            "test_time": self._test_time(result),
            **self.learner.summary(),
        }
        write_text(folder / DONE, json.dumps(document, indent=1) + "\n")
        for _, path in sorted(checkpoints(folder).items())[:-1]:
            discard(path)

    def _resume(self, learner: Learner) -> int:
        """Load the newest checkpoint and drop what was written after it; return the steps done."""
        if not learner.resumable:
            discard_all(self.folder)
        steps, _ = load_newest(self.folder, learner.load)
        self.rows = [row for row in read_progress(self.folder) if row[STEPS] <= steps]
        if not self.rows:
            (self.folder / PROGRESS).unlink(missing_ok=True)
        self.seconds = float(self.rows[-1][SECONDS]) if self.rows else 0.0
        return steps

    def _check(self, n_steps: int) -> None:
        """Test, write a row, take a checkpoint."""
        self.seconds += time.perf_counter() - self._clock
        result = self.result = self._test(n_steps)
        row = {STEPS: n_steps, SECONDS: round(self.seconds, 1), "eval/success_rate": result.success_rate}
        row |= {"eval/n_pairs": len(result.pairs), **{k: round(v, 6) for k, v in self.learner.summary().items()}}
        self.rows.append(row)
        text = io.StringIO()
        writer = csv.DictWriter(text, list(self.rows[-1]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(self.rows)
        write_text(self.folder / PROGRESS, text.getvalue())
        snapshot = self.learner.snapshot()
        if snapshot is not None:
            document = json.dumps({"steps": n_steps, **snapshot})
            write_text(self.folder / f"graph_{n_steps}.json", document + "\n")
        take_checkpoint(self.folder, n_steps, self.learner.save)
        self._clock = time.perf_counter()

    def _test(self, n_steps: int) -> PairsResult:
        spec = self.spec
        n_pairs = spec.final_pairs if n_steps >= spec.steps else spec.pairs
        return evaluate_pairs(
            self.learner.policy, spec.env_id, env_kwargs=spec.env_kwargs, n_pairs=n_pairs, seed=spec.seed + 1000
        )

    def _test_time(self, result: PairsResult) -> list[list[bool]]:
        """Let copies go on learning with one pair each; return, pair by pair, what every test gave."""
        spec = self.spec
        env_kwargs = {"terminate_on_success": True, **spec.env_kwargs}
        curves = []
        for pair in result.pairs[: spec.test_pairs]:
            pinned, test = (gym.make(spec.env_id, **env_kwargs) for _ in range(2))
            test.reset(seed=spec.seed)
            practice = Pinned(pinned, pair.start, pair.goal)
            twins = self.learner.practise(practice, pair.start, pair.goal, [STRETCH] * spec.test_stretches)
            curves.append([run_pair(twin, test, pair.start, pair.goal, pair.path_length).success for twin in twins])
            pinned.close()
            test.close()
        return curves


class Pinned(gym.Wrapper):
    """Begins every episode at one start, with one goal.

    :param env: an environment whose ``reset`` takes both
    :param start: shape ``(goal_dim,)``
    :param goal: shape ``(goal_dim,)``
    """

    def __init__(self, env: gym.Env, start: np.ndarray, goal: np.ndarray) -> None:
        super().__init__(env)
        self.options = {"start": start, "goal": goal}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode.

        :param seed: seeds the wrapped environment
        :param options: not used
        """
        return self.env.reset(seed=seed, options=self.options)


def status(specs: Sequence[RunSpec], out: Path) -> list[RunStatus]:
    """Tell how runs stand.

    :param specs: the runs
    :param out: folder for all of them
    """
    return [_status(spec, out) for spec in specs]


def by_method(runs: Sequence[RunStatus]) -> dict[tuple[str, str], list[RunStatus]]:
    """Group runs by environment and method.

    :param runs: how they stand
    :return: in the order of their first
    """
    groups: dict[tuple[str, str], list[RunStatus]] = {}
    for run in runs:
        groups.setdefault((run.spec.environment, run.spec.method), []).append(run)
    return groups


def _status(spec: RunSpec, out: Path) -> RunStatus:
    folder = spec.folder(out)
    try:
        if has_other_settings(spec, out):
            return RunStatus(spec, "other", 0, None, None)
        rows = read_progress(folder)
    except ValueError:  # damaged: who does the run says how
        return RunStatus(spec, "failed", 0, None, None)
    steps = rows[-1][STEPS] if rows else 0
    rate = float(rows[-1]["eval/success_rate"]) if rows else None
    if (folder / DONE).exists():
        return RunStatus(spec, "done", steps, 0.0, rate)
    # At test time copies learn with each pair; what does not resume begins anew.
    total = spec.steps + spec.test_pairs * spec.test_stretches * STRETCH
    a_step = float(rows[-1][SECONDS]) / steps if rows else None
    if _is_locked(folder):
        return RunStatus(spec, "running", steps, a_step and a_step * (total - steps), rate)
    kept = max(checkpoints(folder), default=0) if ALGORITHMS[spec.algorithm].resumable else 0
    left = a_step and a_step * (total - kept)
    if (folder / ERROR).exists():
        return RunStatus(spec, "failed", kept, left, rate)
    return RunStatus(spec, "stopped" if (folder / CONFIG).exists() else "waiting", kept, left, rate)


def _is_locked(folder: Path) -> bool:
    if not (folder / LOCK).exists():
        return False
    try:
        with FileLock(folder / LOCK, timeout=0):
            return False
    except Timeout:
        return True
