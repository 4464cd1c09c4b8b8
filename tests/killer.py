"""A run that is killed, interrupted or out of disk at any moment: the same command goes on and comes to the same.

    python -m tests.killer --random 100      # every file operation, random moments, 20 sizes at which writing fails

A small training run goes on until it is killed: in a process of its own each time, which has imported everything already.
"""

import argparse
import multiprocessing
import os
import resource
import shutil
import signal
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from sb3_skillgraph import cli
from sb3_skillgraph.experiments import training
from sb3_skillgraph.experiments.run_folder import AGENT, EXPERIENCE, checkpoints, read_progress

if __package__:  # python -m tests.killer
    from tests.conftest import differences, state_in, without_clock
else:
    from conftest import differences, state_in, without_clock

TOY = "SkillGraph/ToyMaze-v0"
COMMAND = ["train", TOY, "--steps", "500", "--env-kwargs", "max_steps=50", "--hyperparams", "learning_starts=100"]
COMMAND += ["batch_size=16", "policy_kwargs={net_arch: [8, 8]}", "buffer_size=2000", "--out"]
#: Events of Python's audit hooks that tell of a file operation; of those that open files, only in the run's folder.
OPERATIONS = {"os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.chmod", "os.truncate", "shutil.rmtree", "shutil.copyfile"}
#: Seconds that a run may take.
PATIENCE = 120
CLOCK = ("time/fps", "time/time_elapsed")
#: What happens to a run: it is given to the process before the run begins.
Fate = Callable[[Path], None]
_PROCESSES = multiprocessing.get_context("forkserver")  # a fork of what has trained already may hang
_PROCESSES.set_forkserver_preload(["sb3_skillgraph.cli", "pytest"])


# -- fates -------------------------------------------------------------------------------------------------------------


class KilledAt:
    """Killed before its n-th file operation.

    :param n: which, counted from 1; 0 for never
    :param counted: receives how many there were
    """

    def __init__(self, n: int, counted: Any = None) -> None:
        self.left = n
        self.counted = counted

    def __call__(self, folder: Path) -> None:
        """Listen to what the process does."""
        sync = os.fsync

        def synced(handle: int) -> None:
            self._operation()
            sync(handle)

        def listen(event: str, arguments: tuple[Any, ...]) -> None:
            opened = event == "open" and isinstance(arguments[0], str | Path) and str(folder) in str(arguments[0])
            if opened or event in OPERATIONS:
                self._operation()

        os.fsync = synced
        sys.addaudithook(listen)

    def _operation(self) -> None:
        self.left -= 1
        if self.counted is not None:
            self.counted.value += 1
        if self.left == 0:
            os.kill(os.getpid(), signal.SIGKILL)


class OutOfDisk:
    """Nothing that is written may be longer than so many bytes.

    :param n_bytes: of the longest file
    """

    def __init__(self, n_bytes: int) -> None:
        self.n_bytes = n_bytes

    def __call__(self, folder: Path) -> None:
        """Set the limit."""
        resource.setrlimit(resource.RLIMIT_FSIZE, (self.n_bytes, resource.RLIM_INFINITY))


# -- runs --------------------------------------------------------------------------------------------------------------


def _work(folder: Path, fate: Fate | None) -> None:
    os.dup2(os.open(folder.with_suffix(".log"), os.O_WRONLY | os.O_CREAT | os.O_APPEND), 1)
    os.dup2(1, 2)
    training.CHECKPOINT_EVERY, training.STOP_EVERY = 100, 50
    if fate is not None:
        fate(folder)
    sys.exit(cli.main([*COMMAND, str(folder)]))


def run(folder: Path, fate: Fate | None = None, signals: tuple[int, ...] = (), after: float = 0.0) -> int:
    """Do the run, or go on with it, in a process of its own.

    :param folder: of the run
    :param fate: what happens to it
    :param signals: that it receives, .05 s between them
    :param after: seconds before the first
    :return: how the process ended
    :raises TimeoutError: if it does not
    """
    process = _PROCESSES.Process(target=_work, args=(folder, fate))
    process.start()
    for i, number in enumerate(signals):
        process.join(after if i == 0 else 0.05)
        if process.is_alive() and process.pid is not None:
            os.kill(process.pid, number)
    process.join(PATIENCE)
    if process.is_alive():
        process.kill()
        raise TimeoutError(f"the run in {folder} took more than {PATIENCE} s")
    assert process.exitcode is not None
    return process.exitcode


def result_of(folder: Path) -> dict[str, Any]:
    """Return all that a run has come to, without times."""
    state = without_clock(state_in(folder / AGENT, folder / EXPERIENCE))
    # SB3 takes the columns out of a set, in any order.
    rows = [sorted(row.items()) for row in read_progress(folder)]
    rows = [[(name, value) for name, value in row if name not in CLOCK] for row in rows]
    return {**state, "progress": rows, "files": sorted(path.name for path in folder.iterdir())}


def faults(folder: Path, undisturbed: dict[str, Any]) -> list[str]:
    """Give the same command once more, and tell what is wrong then.

    :param folder: of a run that was disturbed
    :param undisturbed: what it has to come to
    """
    left = sorted(str(path.relative_to(folder)) for path in folder.rglob("*")) if folder.exists() else []
    was_done = (folder / "done.json").exists()
    code = run(folder)
    if code != (cli.USER_ERROR if was_done else 0):
        log = folder.with_suffix(".log").read_text(errors="replace")[-1500:]
        return [f"the command ends with {code}; there was {left}\n{log}"]
    if checkpoints(folder):
        return ["there are checkpoints left"]
    return differences(undisturbed, result_of(folder))


class Campaign:
    """Disturbs runs, each in a new folder, and gathers what goes wrong.

    :param place: folder for all of them
    """

    def __init__(self, place: Path) -> None:
        self.place = place
        self.failures: list[str] = []
        self.endings: dict[int, int] = {}
        counted = _PROCESSES.Value("i", 0)
        run(place / "warm")  # what is compiled once is compiled now
        assert run(place / "counted", KilledAt(0, counted)) == 0, (place / "counted.log").read_text()
        self.n_operations: int = counted.value
        begin = time.perf_counter()
        assert run(place / "alone") == 0, (place / "alone.log").read_text()
        self.seconds = time.perf_counter() - begin
        self.undisturbed = result_of(place / "alone")

    def disturb(self, what: str, fate: Fate | None = None, signals: tuple[int, ...] = (), after: float = 0.0) -> bool:
        """Disturb a run, and let the same command go on.

        :param what: the disturbance, for people
        :param fate: see :func:`run`
        :param signals: likewise
        :param after: likewise
        :return: whether it was in time
        """
        folder = self.place / "disturbed"
        shutil.rmtree(folder, ignore_errors=True)
        folder.with_suffix(".log").unlink(missing_ok=True)
        code = run(folder, fate, signals, after)
        self.endings[code] = self.endings.get(code, 0) + 1
        self.failures += [f"{what} (ended with {code}): {fault}" for fault in faults(folder, self.undisturbed)]
        return code != 0

    def at_operations(self, every: int = 1) -> None:
        """Kill at file operations.

        :param every: all of them, or each so many-th
        """
        for n in range(1, self.n_operations + 1, every):
            self.disturb(f"killed before file operation {n}", KilledAt(n))

    def at_random(self, n: int, seed: int = 0) -> None:
        """Send signals at random moments.

        :param n: how often
        :param seed: of the moments
        """
        rng = np.random.default_rng(seed)
        kinds = [(signal.SIGKILL,), (signal.SIGTERM,), (signal.SIGINT,), (signal.SIGINT, signal.SIGINT)]
        in_time = 0
        while in_time < n:
            after, signals = float(rng.uniform(0.0, self.seconds)), kinds[in_time % len(kinds)]
            in_time += self.disturb(f"{[s.name for s in signals]} after {after:.3f} s", signals=signals, after=after)

    def out_of_disk(self, n: int) -> None:
        """Let writing fail, from the smallest file to the largest.

        :param n: how many sizes
        """
        largest = max(path.stat().st_size for path in (self.place / "alone").iterdir())
        for n_bytes in np.linspace(0, largest, n + 1)[:-1].astype(int).tolist():
            self.disturb(f"no file may be longer than {n_bytes} bytes", OutOfDisk(n_bytes))


def main() -> int:
    """Disturb many runs, and print what must not be."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--random", type=int, default=100, help="random moments")
    parser.add_argument("--every", type=int, default=1, help="only each so many-th file operation")
    parser.add_argument("--sizes", type=int, default=20, help="sizes at which writing fails")
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    with tempfile.TemporaryDirectory() as place:
        campaign = Campaign(Path(place))
        print(f"{campaign.n_operations} file operations, {campaign.seconds:.1f} s", flush=True)
        stages: list[Callable[[], None]] = [
            lambda: campaign.at_operations(args.every),
            lambda: campaign.at_random(args.random),
            lambda: campaign.out_of_disk(args.sizes),
        ]
        for stage in stages:
            before = len(campaign.failures)
            stage()
            print("\n".join(campaign.failures[before:]), f"endings so far: {campaign.endings}", flush=True)
    return int(bool(campaign.failures))


if __name__ == "__main__":
    sys.exit(main())
