"""What a run keeps in its folder: checkpoints, from which it goes on exactly, its log, and a mark when it is done."""

import csv
import json
import re
import shutil
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import torch as th
from filelock import FileLock
from stable_baselines3.common.type_aliases import GymEnv

from sb3_skillgraph.agent import SkillGraphAgent
from sb3_skillgraph.files import PARTIAL, sync_folder

AGENT, EXPERIENCE, CONFIG, PROGRESS, DONE = "agent.zip", "experience.zip", "config.json", "progress.csv", "done.json"
LOCK, UNNAMED = "lock", f"checkpoint{PARTIAL}"  # a checkpoint before it is whole, and after it has been let go
ERROR = "error.txt"
STEPS, SECONDS = "time/total_timesteps", "time/seconds"
N_KEPT = 2  # checkpoints: should the newest be damaged, there is another
T = TypeVar("T")


@contextmanager
def claimed(folder: Path) -> Iterator[None]:
    """Keep a folder to oneself, and clear away what a command that was killed left half written.

    :param folder: of a run; it is made if it is not there
    :raises filelock.Timeout: if another process is at work in it
    """
    folder.mkdir(parents=True, exist_ok=True)
    # The lock falls with the process that holds it, however that ends; a look at its status takes it for a moment.
    with FileLock(folder / LOCK, timeout=1):
        shutil.rmtree(folder / UNNAMED, ignore_errors=True)
        for path in folder.glob(f".*{PARTIAL}"):
            path.unlink()
        yield


def checkpoints(folder: Path) -> dict[int, Path]:
    """Find a run's checkpoints.

    :param folder: of the run
    :return: by the number of steps
    """
    found = ((re.fullmatch(r"checkpoint_(\d+)", path.name), path) for path in folder.glob("checkpoint_*"))
    return {int(match[1]): path for match, path in found if match and path.is_dir()}


def load_newest(folder: Path, load: Callable[[Path], T]) -> tuple[int, T | None]:
    """Load the newest checkpoint that can be read.

    :param folder: of the run
    :param load: loads a checkpoint
    :return: its steps, and what was loaded; ``(0, None)`` if there are no checkpoints
    :raises ValueError: if there are some, and none can be read
    """
    saved = checkpoints(folder)
    for n_steps in sorted(saved, reverse=True):
        try:
            return n_steps, load(saved[n_steps])
        except Exception as error:  # whatever is raised for a damaged file
            warnings.warn(f"{saved[n_steps]} cannot be read and is left out: {error}", stacklevel=2)
    if saved:
        raise ValueError(f"None of the checkpoints in {folder} can be read: remove them to begin anew.")
    return 0, None


def read_json(path: Path) -> dict[str, Any]:
    """Read a document that a run has written.

    :param path: the file
    :raises ValueError: if it is damaged
    """
    try:
        document = json.loads(path.read_text())
        if not isinstance(document, dict):
            raise TypeError(f"it holds a {type(document).__name__}")
        return document
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path} is damaged: {error}.") from error


def run_config(folder: Path) -> dict[str, Any]:
    """Read what a run was asked to do.

    :param folder: of the run
    :raises ValueError: if its file is damaged
    """
    config = read_json(folder / CONFIG)
    try:
        return {**config, "steps": int(config["steps"]), "env_kwargs": dict(config["env_kwargs"])}
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{folder / CONFIG} is damaged: {error!r}.") from error


def stops(begin: int, end: int, every: int) -> list[int]:
    """Return the numbers of steps at which a run stops for a checkpoint or a test, its end the last of them.

    :param begin: steps done already
    :param end: steps in all
    :param every: steps between stops
    """
    return [*range(begin + every - begin % every, end, every), end]


def take_checkpoint(folder: Path, n_steps: int, save: Callable[[Path], None]) -> None:
    """Take a checkpoint, and let go of the oldest; whenever this is broken off, there are whole ones.

    :param folder: of the run
    :param n_steps: environment steps done
    :param save: fills an empty folder
    """
    saved = checkpoints(folder)
    if n_steps in saved:  # one that could not be read
        discard(saved.pop(n_steps))
    partial = folder / UNNAMED
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir()
    save(partial)
    partial.rename(folder / f"checkpoint_{n_steps}")
    sync_folder(folder)
    for _, path in sorted(saved.items(), reverse=True)[N_KEPT - 1 :]:
        discard(path)


def discard(checkpoint: Path) -> None:
    """Remove a checkpoint, which is none any more before its first file is gone.

    :param checkpoint: its folder
    """
    partial = checkpoint.with_name(UNNAMED)
    shutil.rmtree(partial, ignore_errors=True)
    checkpoint.rename(partial)
    shutil.rmtree(partial)


def discard_all(folder: Path) -> None:
    """Remove a run's checkpoints.

    :param folder: of the run
    """
    for path in checkpoints(folder).values():
        discard(path)


def save_agent(agent: SkillGraphAgent, folder: Path) -> None:
    """Save an agent and its experience.

    :param agent: the agent, between two calls of ``learn``
    :param folder: of a checkpoint
    """
    agent.save(folder / AGENT)
    agent.save_replay_buffer(folder / EXPERIENCE)


def load_agent(folder: Path, env: GymEnv, device: th.device | str = "auto", **given: Any) -> SkillGraphAgent:
    """Load an agent and its experience.

    :param folder: of a checkpoint
    :param env: the environment it is to go on in
    :param device: torch device
    :param given: arguments of which the file holds the names only
    """
    agent = SkillGraphAgent.load(folder / AGENT, env=env, device=device, **given)
    agent.load_replay_buffer(folder / EXPERIENCE)
    return agent


def read_progress(folder: Path) -> list[dict[str, Any]]:
    """Read a run's rows.

    :param folder: of the run, or of a checkpoint
    :raises ValueError: if its file is damaged
    """
    path = folder / PROGRESS
    if not path.exists():
        return []
    try:
        with path.open(newline="") as file:
            rows = list(csv.DictReader(file))
        return [{**row, STEPS: int(row[STEPS])} for row in rows]
    except (KeyError, TypeError, ValueError, csv.Error) as error:
        raise ValueError(f"{path} is damaged: {error!r}.") from error
