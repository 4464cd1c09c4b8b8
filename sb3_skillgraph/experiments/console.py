"""What all commands share: errors for people, arguments in YAML, and the versions in use."""

import argparse
import re
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

import gymnasium as gym
import yaml

from sb3_skillgraph.version import __version__

_VERSIONS_OF = ("stable_baselines3", "torch", "gymnasium", "gymnasium_robotics", "mujoco", "numpy")


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
    """Return the versions of everything that a run's results may depend on, and the commit, if it is known."""
    return {"sb3_skillgraph": __version__, "commit": commit(), **{name: version(name) for name in _VERSIONS_OF}}


def commit() -> str:
    """Return the commit that this package was checked out from by git; an empty string for an installed one."""
    package = Path(__file__).parents[1]
    for command in (["ls-files", "--error-unmatch", "version.py"], ["rev-parse", "--short", "HEAD"]):
        try:
            told = subprocess.run(["git", "-C", str(package), *command], capture_output=True, text=True, check=True)
        except (OSError, subprocess.CalledProcessError):
            return ""
    return told.stdout.strip()


def positive(text: str) -> int:
    """Read a positive whole number, with underscores or as ``1e4``.

    :param text: what was typed
    """
    number = float(text.replace("_", ""))
    if not number.is_integer() or number < 1:
        raise argparse.ArgumentTypeError(f"must be a whole number, at least 1, not {text}")
    return int(number)


def numbers(value: Any) -> Any:
    """Return a value with numbers in place of texts such as ``1e4``, which YAML takes for no number without a dot.

    :param value: as YAML gives it
    """
    if isinstance(value, list):
        return [numbers(item) for item in value]
    if isinstance(value, dict):
        return {name: numbers(item) for name, item in value.items()}
    if not (isinstance(value, str) and re.fullmatch(r"[-+]?[0-9][0-9_]*(\.[0-9]*)?e[-+]?[0-9]+", value, re.IGNORECASE)):
        return value
    number = float(value)
    return int(number) if number.is_integer() else number


def assignment(text: str) -> tuple[str, Any]:
    """Read ``NAME=VALUE``, the value in YAML.

    :param text: what was typed
    """
    name, equals, value = text.partition("=")
    if not (name and equals):
        raise argparse.ArgumentTypeError(f"{text!r} is not of the form NAME=VALUE")
    try:
        return name, numbers(yaml.safe_load(value))
    except yaml.YAMLError as error:
        raise argparse.ArgumentTypeError(f"the value of {name} is no valid YAML: {value!r}") from error
