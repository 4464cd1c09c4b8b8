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
from typing import Any, Literal

import torch as th
from filelock import Timeout
from joblib import Parallel, delayed, parallel_config

from sb3_skillgraph.experiments.console import versions
from sb3_skillgraph.experiments.learner import Learner
from sb3_skillgraph.experiments.learners import ALGORITHMS
from sb3_skillgraph.experiments.plan import RunSpec
from sb3_skillgraph.experiments.run_folder import (
    CONFIG,
    DONE,
    ERROR,
    PROGRESS,
    SECONDS,
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
from sb3_skillgraph.experiments.status import has_other_settings, settings, status
from sb3_skillgraph.experiments.testing import Test, learn_at_test_time, test_policy
from sb3_skillgraph.files import write_text

Outcome = Literal["done", "skipped", "elsewhere", "failed", "refused"]


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
        self.last: Test | None = None
        self.rows: list[dict[str, Any]] = []
        self.seconds = 0.0
        self._clock = 0.0

    def do(self) -> None:
        spec, folder = self.spec, self.folder
        (folder / ERROR).unlink(missing_ok=True)
        self.learner = ALGORITHMS[spec.algorithm](spec.env_id, spec.env_kwargs, spec.seed, spec.arguments)
        begin = self._resume(self.learner)
        if not begin:
            document = {**json.loads(settings(spec)), "versions": versions()}
            write_text(folder / CONFIG, json.dumps(document, indent=1) + "\n")
        self._clock = time.perf_counter()
        if begin < spec.steps:
            self.learner.learn(begin, spec.steps, spec.check_every, self._check)
        test = self.last or test_policy(self.learner.policy, spec, spec.steps)
        document = {
            **test.as_plain(),
            "seconds": round(self.seconds, 1),
            "also": {name: self._test_rival(rival) for name, rival in spec.also.items()},
            "test_time": learn_at_test_time(self.learner, spec, test.pairs),
            **self.learner.summary(),
        }
        write_text(folder / DONE, json.dumps(document, indent=1) + "\n")
        for _, path in sorted(checkpoints(folder).items())[:-1]:
            discard(path)

    def _test_rival(self, rival: dict[str, Any]) -> dict[str, Any]:
        return test_policy(self.learner.rival(**rival), self.spec, self.spec.steps).as_plain()

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
        test = self.last = test_policy(self.learner.policy, self.spec, n_steps)
        row = {STEPS: n_steps, SECONDS: round(self.seconds, 1), "eval/success_rate": test.pairs.success_rate}
        row |= {"eval/task_success_rate": test.task_success_rate} if test.tasks else {}
        row |= {"eval/n_pairs": len(test.pairs.pairs), **{k: round(v, 6) for k, v in self.learner.summary().items()}}
        write_text(self.folder / f"test_{n_steps}.json", json.dumps(test.as_plain()) + "\n")
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
