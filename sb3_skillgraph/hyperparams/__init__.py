"""Hyperparameters per environment, read from YAML beside this file (the layout of SB3's zoo)."""

import difflib
import fnmatch
import importlib
import inspect
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import gymnasium as gym
import yaml

from sb3_skillgraph.agent import SkillGraphAgent
from sb3_skillgraph.arguments import OPTION_CLASSES
from sb3_skillgraph.goal_env import GoalSpec
from sb3_skillgraph.rules import PAPER

FILE = Path(__file__).parent / "skillgraph.yml"
WRAPPER = "env_wrapper"

# `n_timesteps` is for learn(); the others of these are given by who makes the agent.
_PARAMETERS = inspect.signature(SkillGraphAgent.__init__).parameters
_KNOWN = ({"n_timesteps"} | set(_PARAMETERS)) - {"self", "env", "seed", "_init_setup_model"}


def load_hyperparams(env_id: str, path: Path = FILE, *, required: bool = False) -> dict[str, Any]:
    """Read what is recommended for an environment.

    :param env_id: id of the environment; one without an entry gets the file's ``defaults``
    :param path: YAML file
    :param required: whether there must be an entry, as where its values are for use with another environment
    :return: ``n_timesteps`` and keyword arguments of :class:`~sb3_skillgraph.SkillGraphAgent`, ``policy`` among them
    :raises ValueError: if the file is no YAML of that layout, names an unknown argument or option class, or has no entry
        that is required
    """
    document = _read(path)
    own = _entry_of(env_id, document)
    if required and own not in document:
        raise ValueError(f"{path.name} has no entry {env_id!r}{did_you_mean(env_id, document)}.")
    hyperparams: dict[str, Any] = {}
    for entry in ("defaults", own):
        values = document.get(entry) or {}
        if not isinstance(values, dict):
            raise ValueError(f"{path.name}, entry {entry!r}: a mapping of argument names to values is wanted.")
        settings = {name: value for name, value in values.items() if name != WRAPPER}
        hyperparams.update(check_hyperparams(settings, f"{path.name}, entry {entry!r}"))
    return hyperparams


def _read(path: Path) -> dict[str, Any]:
    try:
        document = yaml.safe_load(path.read_text(encoding="utf-8")) or {}
    except yaml.YAMLError as error:
        raise ValueError(f"{path.name} is no valid YAML: {' '.join(str(error).split())}") from error
    if not isinstance(document, dict):
        raise ValueError(f"{path.name}: a mapping of environments to arguments is wanted.")
    return document


def _entry_of(env_id: str, entries: Iterable[str]) -> str:
    """Return the entry that is for an environment: its own, else the first whose star stands for the rest of its name.

    The package that its id may begin with does not count.
    """
    name = env_id.rpartition(":")[2]
    fitting = (entry for entry in entries if fnmatch.fnmatchcase(name, str(entry)))
    return name if name in entries else next(fitting, name)


def recommended_wrapper(env_id: str) -> Callable[[gym.Env], gym.Env] | None:
    """Return the wrapper that is recommended for an environment; None for most.

    :param env_id: id of the environment
    """
    document = _read(FILE)
    name = (document.get(_entry_of(env_id, document)) or {}).get(WRAPPER)
    if name is None:
        return None
    package, _, wrapper = name.rpartition(".")
    found: Callable[[gym.Env], gym.Env] = getattr(importlib.import_module(package), wrapper)
    return found


def make_recommended(env_id: str, env_kwargs: dict[str, Any]) -> gym.Env:
    """Make a goal environment, with the wrapper that is recommended for it.

    :param env_id: its id
    :param env_kwargs: its keyword arguments
    :raises ValueError: if it is none
    """
    env, wrapper = gym.make(env_id, **env_kwargs), recommended_wrapper(env_id)
    env = env if wrapper is None else wrapper(env)
    GoalSpec.of(env.observation_space, env.action_space)
    return env


def check_hyperparams(values: dict[str, Any], origin: str) -> dict[str, Any]:
    """Check names and numbers of hyperparameters, and put option classes and ``PAPER`` in place of their names.

    :param values: hyperparameters as YAML gives them
    :param origin: where they come from, for the messages
    :return: hyperparameters as :class:`~sb3_skillgraph.SkillGraphAgent` takes them
    :raises ValueError: if an argument or an option class is unknown, or no number is given where one is wanted
    """
    for name in values:
        if name not in _KNOWN:
            raise ValueError(f"{origin}: unknown argument {name!r}{did_you_mean(str(name), _KNOWN)}.")
    checked = {name: _number(name, value, origin) for name, value in values.items()}
    if "option_class" in checked:
        name = checked["option_class"]
        if name not in OPTION_CLASSES:
            raise ValueError(f"{origin}: unknown option_class {name!r}; it is one of {', '.join(OPTION_CLASSES)}.")
        checked["option_class"] = OPTION_CLASSES[name]
    if "rules" in checked:
        if checked["rules"] != "paper":
            raise ValueError(f"{origin}: unknown rules {checked['rules']!r}; there are those of the paper, rules: paper.")
        checked = {**PAPER, **checked, "rules": PAPER["rules"]}
    return checked


def _number(name: str, value: Any, origin: str) -> Any:
    """Return a value as the number its argument wants; YAML takes ``1e-3``, without a dot, for a string."""
    if name == "train_freq" and isinstance(value, list):
        return tuple(value)  # such as (1, "episode")
    parameter = _PARAMETERS.get(name)
    default = parameter.default if parameter is not None else 0  # n_timesteps
    optional = parameter is not None and "None" in str(parameter.annotation)
    if type(default) not in (int, float) or (optional and value is None):
        return value
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise ValueError(f"{origin}: {name} must be a number, not {value!r}.") from None
    return int(number) if number.is_integer() and isinstance(default, int) else number


def did_you_mean(name: str, names: Iterable[str]) -> str:
    """Suggest the names nearest to a mistyped one.

    :param name: the name given
    :param names: the names that exist
    :return: ``"; did you mean 'x' or 'y'?"`` without the question mark, or an empty string
    """
    close = difflib.get_close_matches(name, sorted(names), n=3)
    return f"; did you mean {' or '.join(map(repr, close))}" if close else ""
