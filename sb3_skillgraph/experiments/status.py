"""How the runs of a plan stand."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NamedTuple

from filelock import FileLock, Timeout

from sb3_skillgraph.experiments.learners import ALGORITHMS
from sb3_skillgraph.experiments.plan import RunSpec
from sb3_skillgraph.experiments.run_folder import (
    CONFIG,
    DONE,
    ERROR,
    LOCK,
    PROGRESS,
    SECONDS,
    STEPS,
    checkpoints,
    read_json,
    read_progress,
)
from sb3_skillgraph.experiments.testing import STRETCH
from sb3_skillgraph.experiments.training import plain


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
    now = json.loads(settings(spec))
    return bool(before != now)


def settings(spec: RunSpec) -> str:
    """Return all that is set as JSON: what the plan says, and what is recommended where it is silent.

    :param spec: the run
    """
    resolved = ALGORITHMS[spec.algorithm].resolve(spec.env_id, spec.arguments)
    return json.dumps({**spec.as_plain(), "resolved": resolved}, default=plain)


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
