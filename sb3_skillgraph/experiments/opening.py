"""What commands are given: a run or an agent, and its environment."""

import argparse
from pathlib import Path
from typing import Any

import gymnasium as gym

from sb3_skillgraph.agent import SkillGraphAgent
from sb3_skillgraph.envs import find
from sb3_skillgraph.experiments.console import UserError, assignment, for_people
from sb3_skillgraph.experiments.run_folder import AGENT, CONFIG, checkpoints, run_config
from sb3_skillgraph.hyperparams import did_you_mean, make_recommended


def add_command(commands: Any, name: str, run: Any, summary: str, detail: str) -> argparse.ArgumentParser:
    """Add a command.

    :param commands: argparse's sub-parsers
    :param name: of the command
    :param run: what it does
    :param summary: in one line
    :param detail: more, with an example
    :return: its parser
    """
    command: argparse.ArgumentParser = commands.add_parser(
        name, help=summary, description=f"{summary}\n\n{detail}", formatter_class=argparse.RawDescriptionHelpFormatter
    )
    command.set_defaults(run=run)
    return command


def seed(text: str) -> int:
    """Read a seed.

    :param text: as it was typed
    :raises argparse.ArgumentTypeError: if it is none
    """
    if not text.isdecimal() or int(text) >= 2**32:
        raise argparse.ArgumentTypeError(f"a seed is a whole number from 0 to {2**32 - 1}, not {text!r}")
    return int(text)


def add_seed(command: argparse.ArgumentParser) -> None:
    """Add the seed of a command that draws something.

    :param command: its parser
    """
    command.add_argument("--seed", type=seed, default=0, help="seed of everything random (default: 0)")


def add_env_kwargs(command: argparse.ArgumentParser) -> None:
    """Add the arguments of an environment.

    :param command: a command's parser
    """
    command.add_argument(
        "--env-kwargs",
        nargs="+",
        type=assignment,
        default=[],
        metavar="NAME=VALUE",
        help="arguments of the environment, values in YAML: maze_map=[[1,1,1],[1,0,1],[1,1,1]]",
    )


def add_agent(command: argparse.ArgumentParser) -> None:
    """Add the run, or the agent, that a command is about.

    :param command: its parser
    """
    command.add_argument("agent", type=Path, metavar="RUN", help="folder that train has filled, or an agent.zip")
    command.add_argument("--env", metavar="ENV", help="environment id (default: that of the run)")
    add_env_kwargs(command)


def check_env_id(env_id: str) -> None:
    """Find an environment by its id, importing the package named before a colon.

    :param env_id: its id
    :raises UserError: if there is none
    """
    try:
        find(env_id)
    except (gym.error.Error, ImportError) as error:
        known = list(gym.registry)
        # Who leaves out SkillGraph/ means one of ours
        full = {id.rpartition("/")[2]: id for id in known if "/" in id}.get(env_id)
        hint = f"; did you mean {full!r}" if full else did_you_mean(env_id, known)
        reason = f": {error}" if isinstance(error, ImportError) else ""
        raise UserError(f"there is no environment {env_id!r}{reason}{hint}.") from error


def find_run(args: argparse.Namespace) -> tuple[Path, str, dict[str, Any]]:
    """Return the agent's file, and the environment that was asked for, else that of its run.

    :param args: what :func:`add_agent` has read
    :return: the file, the environment's id and its keyword arguments
    :raises UserError: if it is not known which environment
    """
    path = args.agent / AGENT if args.agent.is_dir() else args.agent
    if not args.agent.exists():
        raise UserError(f"there is no {args.agent}: give a folder that train has filled, or an agent.zip.")
    if not path.exists():
        inside = ", ".join(folder.name for folder in checkpoints(args.agent).values())
        raise UserError(f"there is no {AGENT} in {args.agent}" + (f"; there are checkpoints: {inside}." if inside else "."))
    config: dict[str, Any] = {}
    if path.with_name(CONFIG).exists():
        with for_people():
            config = run_config(path.parent)
    asked = dict(args.env_kwargs)
    if args.env is None:
        if not config:
            raise UserError(
                f"{path} was not left there by train (no {CONFIG} beside it): say with --env in which environment."
            )
        env_id, env_kwargs = str(config["env"]), {**config["env_kwargs"], **asked}
    else:
        env_id, env_kwargs = str(args.env), asked
    if config and (env_id, env_kwargs) != (config["env"], config["env_kwargs"]):
        print(f"warning: the agent was trained in {config['env']} {config['env_kwargs'] or ''}".rstrip())
    return path, env_id, env_kwargs


def make_env(env_id: str, env_kwargs: dict[str, Any]) -> gym.Env:
    """Make an environment.

    :param env_id: its id
    :param env_kwargs: its keyword arguments
    :raises UserError: if there is none, or it refuses an argument
    """
    check_env_id(env_id)
    with for_people():
        return make_recommended(env_id, env_kwargs)


def load_agent(path: Path, env: gym.Env) -> SkillGraphAgent:
    """Load an agent.

    :param path: its file
    :param env: its environment
    :raises UserError: if it cannot be loaded
    """
    with for_people():
        return SkillGraphAgent.load(path, env=env)
