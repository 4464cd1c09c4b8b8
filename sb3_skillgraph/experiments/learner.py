"""What every method is to a run: it learns from check to check, is saved, and may be loaded and go on."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from inspect import signature
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.type_aliases import PolicyPredictor

from sb3_skillgraph.hyperparams import did_you_mean

Check = Callable[[int], None]


class Learner(ABC):
    """A method at work on one environment.

    :param env_id: id of the environment
    :param env_kwargs: its keyword arguments
    :param seed: of everything random
    :param arguments: of the method
    """

    #: Whether it can go on from a checkpoint as if nothing had happened; others begin anew.
    resumable = False
    policy: PolicyPredictor

    @abstractmethod
    def __init__(self, env_id: str, env_kwargs: dict[str, Any], seed: int, arguments: dict[str, Any]) -> None: ...

    @classmethod
    @abstractmethod
    def check_arguments(cls, arguments: dict[str, Any], where: str) -> None:
        """Check the names of the method's arguments.

        :param arguments: as a plan gives them
        :param where: that is, for the message
        :raises ValueError: if there is one of which it has none
        """

    @classmethod
    def resolve(cls, env_id: str, arguments: dict[str, Any]) -> dict[str, Any]:
        """Return the arguments the method gets: those of the plan, beside what is recommended for the environment.

        :param env_id: id of the environment
        :param arguments: as a plan gives them
        """
        return arguments

    @abstractmethod
    def learn(self, begin: int, end: int, every: int, check: Check) -> None:
        """Learn, and stop for a check every so often and at the end.

        :param begin: steps done already
        :param end: steps in all
        :param every: steps between checks
        :param check: called with the number of steps
        """

    @abstractmethod
    def save(self, folder: Path) -> None:
        """Take a checkpoint: all that is needed to go on, if that is possible, else what has been learned.

        :param folder: an empty folder
        """

    def load(self, folder: Path) -> None:  # noqa: B027
        """Go on from a checkpoint.

        :param folder: what :meth:`save` has filled
        """

    @abstractmethod
    def practise(self, env: gym.Env, start: np.ndarray, goal: np.ndarray, stretches: list[int]) -> Iterator[PolicyPredictor]:
        """Go on learning, as a copy, with one start and one goal, as at the paper's test time (section 4.2).

        :param env: begins every episode at the start, with the goal, and ends it there
        :param start: shape ``(goal_dim,)``
        :param goal: shape ``(goal_dim,)``
        :param stretches: environment steps from one test to the next
        :return: what is to be tested: at once, and after every stretch
        """

    def rival(self, algorithm: str, arguments: dict[str, Any] | None = None) -> PolicyPredictor:
        """Return another way to act by what has been learned.

        :param algorithm: one of ``RIVALS``
        :param arguments: of it
        """
        raise NotImplementedError

    def summary(self) -> dict[str, float]:
        """Return what else is worth a column."""
        return {}

    def snapshot(self) -> dict[str, Any] | None:
        """Return what is worth a picture, as plain data."""
        return None


def check_names(arguments: dict[str, Any], where: str, *takers: Callable[..., Any]) -> None:
    """Check the names of arguments.

    :param arguments: as a plan gives them
    :param where: that is, for the message
    :param takers: what takes them
    :raises ValueError: if there is one that none of these takes
    """
    given = {"self", "env", "agent", "seed", "policy", "kwargs"}
    known = {name for taker in takers for name in signature(taker).parameters} - given
    for name in arguments:
        if name not in known:
            raise ValueError(f"{where}: unknown argument {name!r}{did_you_mean(str(name), known)}.")
