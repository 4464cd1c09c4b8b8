"""What a run keeps in its folder: checkpoints, from which it goes on exactly, and its log."""

import csv
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch as th
from stable_baselines3.common.type_aliases import GymEnv

from sb3_skillgraph.agent import SkillGraphAgent
from sb3_skillgraph.saving import load_tree

AGENT, EXPERIENCE, CONFIG, PROGRESS = "agent.zip", "experience.zip", "config.json", "progress.csv"
STEPS = "time/total_timesteps"


def checkpoints(folder: Path) -> dict[int, Path]:
    """Find a run's checkpoints.

    :param folder: of the run
    :return: by the number of steps
    """
    found = (path for path in folder.glob("checkpoint_*") if path.is_dir())
    return {int(path.name.partition("_")[2]): path for path in found}


def run_config(folder: Path) -> dict[str, Any]:
    """Read what a run was asked to do.

    :param folder: of the run
    :raises ValueError: if its file is damaged
    """
    path = folder / CONFIG
    try:
        config: dict[str, Any] = json.loads(path.read_text())
        return {**config, "steps": int(config["steps"]), "env_kwargs": dict(config["env_kwargs"])}
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path} is damaged: {error!r}.") from error


def is_unfinished(folder: Path) -> bool:
    """Tell whether a folder holds a run that was broken off: it has a checkpoint or, before there was one, too few steps.

    :param folder: of the run
    :raises ValueError: if its agent is damaged
    """
    if checkpoints(folder):
        return True
    if not ((folder / AGENT).exists() and (folder / CONFIG).exists()):
        return False
    n_steps: int = load_tree(folder / AGENT, "agent")["progress"]["counters"]["num_timesteps"]
    return bool(n_steps < run_config(folder)["steps"])


def stops(begin: int, end: int, every: int) -> list[int]:
    """Return the numbers of steps at which a run stops for a checkpoint or a test, its end the last of them.

    :param begin: steps done already
    :param end: steps in all
    :param every: steps between stops
    """
    return [*range(begin + every - begin % every, end, every), end]


def take_checkpoint(folder: Path, n_steps: int, save: Callable[[Path], None]) -> None:
    """Take a checkpoint, and let go of those before; whenever this is broken off, there is a whole one.

    :param folder: of the run
    :param n_steps: environment steps done
    :param save: fills an empty folder
    """
    before = checkpoints(folder)
    partial = folder / "checkpoint.partial"
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir()
    save(partial)
    partial.rename(folder / f"checkpoint_{n_steps}")
    for path in before.values():
        shutil.rmtree(path)


def save_agent(agent: SkillGraphAgent, folder: Path) -> None:
    """Save an agent and its experience.

    :param agent: the agent, between two calls of ``learn``
    :param folder: of a checkpoint
    """
    agent.save(folder / AGENT)
    agent.save_replay_buffer(folder / EXPERIENCE)


def load_agent(folder: Path, env: GymEnv, device: th.device | str = "auto") -> SkillGraphAgent:
    """Load an agent and its experience.

    :param folder: of a checkpoint
    :param env: the environment it is to go on in
    :param device: torch device
    """
    agent = SkillGraphAgent.load(folder / AGENT, env=env, device=device)
    agent.load_replay_buffer(folder / EXPERIENCE)
    return agent


def read_progress(folder: Path) -> list[dict[str, Any]]:
    """Read a run's rows.

    :param folder: of the run
    """
    path = folder / PROGRESS
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return list(csv.DictReader(file))
