"""One agent trained in a folder of its own, with checkpoints to go on from."""

import json
import shutil
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import HumanOutputFormat, Logger, configure

from sb3_skillgraph.agent import SkillGraphAgent
from sb3_skillgraph.callbacks import SkillGraphProgressBarCallback
from sb3_skillgraph.experiments.console import UserError, for_people, versions
from sb3_skillgraph.experiments.run_folder import (
    AGENT,
    CONFIG,
    PROGRESS,
    STEPS,
    checkpoints,
    is_unfinished,
    load_agent,
    read_progress,
    save_agent,
    stops,
    take_checkpoint,
)
from sb3_skillgraph.rules import PaperRules

CHECKPOINT_EVERY = 10_000  # environment steps


def train(
    env_id: str,
    env_kwargs: dict[str, Any],
    arguments: dict[str, Any],
    steps: int,
    seed: int,
    out: Path,
    n_envs: int = 1,
    device: str = "auto",
    verbose: bool = False,
) -> SkillGraphAgent:
    """Train an agent, from the last checkpoint in the folder if there is one; that comes to the same as in one go.

    A run that was broken off before its first checkpoint begins anew.

    :param env_id: id of the environment
    :param env_kwargs: its keyword arguments
    :param arguments: of :class:`~sb3_skillgraph.SkillGraphAgent`
    :param steps: environment steps in all
    :param seed: of everything random
    :param out: receives ``agent.zip`` and ``experience.zip`` (when interrupted, too), ``progress.csv``, ``config.json``
        and, until the end, the newest checkpoint
    :param n_envs: copies of the environment
    :param device: torch device
    :param verbose: whether to print SB3's table as well as the progress bar
    :return: the agent
    :raises UserError: if an argument is refused, or the folder holds a run with other ones
    """
    config = dict(env=env_id, env_kwargs=env_kwargs, steps=steps, seed=seed, n_envs=n_envs, arguments=arguments)
    saved = checkpoints(out)
    if is_unfinished(out):
        _check_config(out, config)
    with for_people():
        env = make_vec_env(env_id, n_envs=n_envs, env_kwargs=env_kwargs)
    try:
        with for_people():
            begin = max(saved, default=0)
            if saved:
                agent = load_agent(saved[begin], env, device)
                fresh = "" if env.has_attr("get_state") else f", at a fresh episode: {env_id} cannot tell its state"
                print(f"going on after {begin} steps{fresh}")
            else:
                agent = SkillGraphAgent(env=env, seed=seed, **{"device": device, **arguments})
        out.mkdir(parents=True, exist_ok=True)
        write_json(out / CONFIG, {**config, "versions": versions()})
        agent.set_logger(_logger(out, agent.num_timesteps, verbose))
        _learn(agent, begin, steps, out)
        return agent
    finally:
        env.close()


def _learn(agent: SkillGraphAgent, begin: int, steps: int, out: Path) -> None:
    bar = SkillGraphProgressBarCallback(steps)
    try:
        for target in stops(begin, steps, CHECKPOINT_EVERY):
            # By what was asked for: a call of several environments may overshoot, and the next makes up for it.
            agent.learn(target - begin, callback=bar, reset_num_timesteps=False)
            begin = target
            if target < steps:
                take_checkpoint(out, target, lambda folder: save_agent(agent, folder))
    finally:
        bar.close()
        agent.logger.close()
        if agent.num_timesteps > 0:
            save_agent(agent, out)
            print(f"{agent.num_timesteps} steps; the agent is in {out / AGENT}, its log in {out / PROGRESS}")
        if agent.num_timesteps < steps:
            print(f"the same command goes on after {max(checkpoints(out), default=0)} steps")
    for path in checkpoints(out).values():
        shutil.rmtree(path)


def _logger(out: Path, n_steps: int, verbose: bool) -> Logger:
    """Return a logger whose file begins with the rows of the steps that are done."""
    rows = [row for row in read_progress(out) if int(row[STEPS]) <= n_steps]
    logger = configure(str(out), ["csv"])
    for row in rows:
        for name, value in row.items():
            if value:
                logger.record(name, float(value) if set(value) - set("-0123456789") else int(value))
        logger.dump(int(row[STEPS]))
    if verbose:
        logger.output_formats.append(HumanOutputFormat(sys.stdout))
    return logger


def _check_config(out: Path, config: dict[str, Any]) -> None:
    before = json.loads((out / CONFIG).read_text())
    del before["versions"]
    if before != json.loads(_as_json(config)):
        raise UserError(
            f"{out} holds an unfinished run with other settings, see its {CONFIG}: give the same ones to go on with it, "
            "or another folder with --out."
        )


def write_json(path: Path, document: dict[str, Any]) -> None:
    """Write a document into a folder that need not be there yet.

    :param path: the file
    :param document: plain data; classes, such as ``option_class``, are written by their names
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(_as_json(document) + "\n")


def _as_json(document: dict[str, Any]) -> str:
    return json.dumps(document, indent=2, default=plain)


def plain(item: Any) -> Any:
    """Return a value of a configuration as JSON can have it: of a class its name, of rules their numbers.

    :param item: the value
    """
    return asdict(item) if isinstance(item, PaperRules) else item.__name__
