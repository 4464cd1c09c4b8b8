"""Builders shared by the tests of the library's inner parts: options with a tiny network, examples that repeat."""

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from hypothesis import HealthCheck, Phase, settings

from sb3_skillgraph.events import TerminationSet
from sb3_skillgraph.memory.store import TransitionStore
from sb3_skillgraph.metric import Ball
from sb3_skillgraph.options.factory import OptionFactory
from sb3_skillgraph.options.initiation import Boundary
from sb3_skillgraph.options.learner import OptionDDPG
from sb3_skillgraph.options.option import Option
from sb3_skillgraph.options.views import ScaledView, View, relative_view

TINY_NETS: dict[str, Any] = {"policy_kwargs": {"net_arch": [4]}}


def profile(max_examples: int, *, shrink: bool = True) -> settings:
    """Hypothesis settings that find the same examples on every machine.

    :param max_examples: number of examples
    :param shrink: whether to look for the smallest failing example, which for long histories takes minutes
    """
    return settings(
        max_examples=max_examples,
        deadline=None,
        derandomize=True,
        database=None,
        phases=[Phase.explicit, Phase.generate, *([Phase.shrink] if shrink else [])],
        suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.filter_too_much],
    )


def make_factory(
    store: TransitionStore,
    *,
    view: View = relative_view,
    radius: float = 1.0,
    tolerance: float = 1.0,
    seed: int = 0,
    **replay_kwargs: Any,
) -> OptionFactory:
    return OptionFactory(
        OptionDDPG,
        TINY_NETS,
        store,
        ScaledView(view, Ball(radius)),
        spaces.Box(-1.0, 1.0, (2,), np.float32),
        tolerance,
        np.random.default_rng(seed),
        {"hindsight": 0.8, "shared": 0.5, "horizon": 50} | replay_kwargs,
        th.device("cpu"),
    )


@functools.cache
def shared_learner() -> OptionDDPG:
    """A real learner with a tiny net, which options may share that are never asked to act or learn."""
    learner = make_factory(TransitionStore(100, 2, 2, 2)).make("shared", None, None).learner
    assert isinstance(learner, OptionDDPG)
    return learner


def disc(center: Sequence[float], radius: float) -> Boundary:
    """The boundary of the open disc around a point."""
    return Boundary(np.array([center], dtype=np.float64), np.ones(1), -float(np.exp(-1.0)), 1.0 / radius**2)


def make_option(
    id: str, target: str | None, termination: TerminationSet | None, *, start: tuple[Sequence[float], float] | None = None
) -> Option:
    """A real option; if a disc ``(center, radius)`` is given it is mature and starts there, most surely in its inner half."""
    option = Option(id, target, termination, shared_learner(), Ball(1.0))
    if start is not None:
        center, radius = start
        option.initiation.optimistic_boundaries = [disc(center, radius)]
        option.initiation.pessimistic_boundaries = [disc(center, 0.5 * radius)]
        option.initiation.core = np.array(center, dtype=np.float64)
        option.mature = True
    return option
