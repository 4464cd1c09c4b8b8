"""What all commands share: errors for people, arguments in YAML, and the versions in use."""

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from typing import Any

import gymnasium as gym
import yaml

_VERSIONS_OF = ("sb3_skillgraph", "stable_baselines3", "torch", "gymnasium", "gymnasium_robotics", "mujoco", "numpy")


class UserError(Exception):
    """Something the user can put right; shown as one line, without a traceback."""


@contextmanager
def for_people() -> Iterator[None]:
    """Say in one line what the library refuses; for the steps that check what the user gave, and for no others."""
    try:
        yield
    except (ValueError, TypeError, RuntimeError, gym.error.Error) as error:
        raise UserError(str(error)) from error


def versions() -> dict[str, str]:
    """Return the versions of everything that a run's results may depend on."""
    return {name: version(name) for name in _VERSIONS_OF}


def positive(text: str) -> int:
    """Read a positive number, underscores allowed.

    :param text: what was typed
    """
    number = int(text.replace("_", ""))
    if number < 1:
        raise argparse.ArgumentTypeError(f"must be at least 1, not {number}")
    return number


def assignment(text: str) -> tuple[str, Any]:
    """Read ``NAME=VALUE``, the value in YAML.

    :param text: what was typed
    """
    name, equals, value = text.partition("=")
    if not (name and equals):
        raise argparse.ArgumentTypeError(f"{text!r} is not of the form NAME=VALUE")
    try:
        return name, yaml.safe_load(value)
    except yaml.YAMLError as error:
        raise argparse.ArgumentTypeError(f"the value of {name} is no valid YAML: {value!r}") from error
