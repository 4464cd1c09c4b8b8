"""Builders shared by the tests of the library's inner parts: options, graphs and worlds with known answers."""

import functools
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from hypothesis import HealthCheck, Phase, settings

from sb3_skillgraph.chaining import DeepSkillChaining
from sb3_skillgraph.controller import Controller
from sb3_skillgraph.events import Event, TerminationSet
from sb3_skillgraph.graph import SkillGraph
from sb3_skillgraph.options.factory import OptionFactory
from sb3_skillgraph.options.initiation import Boundary, InitiationSet
from sb3_skillgraph.options.learner import OptionDDPG
from sb3_skillgraph.options.option import Option
from sb3_skillgraph.options.views import ScaledView, View, relative_view
from sb3_skillgraph.planner import GraphPlanner
from sb3_skillgraph.memory.replay import TransitionStore
from sb3_skillgraph.visited import VisitedStates

TINY_NETS: dict[str, Any] = {"policy_kwargs": {"net_arch": [4]}}
#: The graph as the paper has it: strict, from plain fractions, without edges from evidence.
PAPER_GRAPH: dict[str, Any] = {
    "containment": 1.0,
    "rate_prior": (0.0, 0.0),
    "evidence_edges": False,
    "min_success_rate": 0.0,
    "failure_cost": 1.0,
}
#: Rates and weights that are easily worked out by hand.
PLAIN_WEIGHTS: dict[str, Any] = {"rate_prior": (1.0, 1.0), "min_success_rate": 0.2, "failure_cost": 1.0}


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
    tolerance: float | None = None,
    seed: int = 0,
    **replay_kwargs: Any,
) -> OptionFactory:
    return OptionFactory(
        OptionDDPG,
        TINY_NETS,
        store,
        ScaledView(view, radius),
        spaces.Box(-1.0, 1.0, (2,), np.float32),
        radius,
        radius if tolerance is None else tolerance,
        np.random.default_rng(seed),
        {"hindsight": 0.8, "shared": 0.5, "horizon": 50} | replay_kwargs,
        th.device("cpu"),
    )


@functools.cache
def shared_learner(seed: int) -> OptionDDPG:
    """A real learner with tiny nets: graph, planner and chains ask nothing of it, so that options may share it."""
    learner = make_factory(TransitionStore(100, 2, 2, 2), seed=seed).make("shared", None, None).learner
    assert isinstance(learner, OptionDDPG)
    return learner


def disc(center: Sequence[float], radius: float) -> Boundary:
    """The boundary of the open disc around a point."""
    return Boundary(np.array([center], dtype=np.float64), np.ones(1), -float(np.exp(-1.0)), 1.0 / radius**2)


def put_initiation(initiation: InitiationSet, center: Sequence[float], radius: float) -> None:
    """Make an initiation set a disc; the half as wide one is its pessimistic core."""
    initiation.optimistic_boundaries = [disc(center, radius)]
    initiation.pessimistic_boundaries = [disc(center, 0.5 * radius)]
    initiation.core = np.array(center, dtype=np.float64)


def make_option(
    id: str,
    target: str | None,
    termination: TerminationSet | None,
    *,
    start: tuple[Sequence[float], float] | None = None,
    effects: Iterable[Sequence[float]] = (),
    record: Iterable[bool] = (),
    seed: int = 1,
) -> Option:
    """A real option with a shared learner; mature, with a disc ``(center, radius)`` to start from, if one is given."""
    option = Option(id, target, termination, shared_learner(seed), 1.0)
    if start is not None:
        put_initiation(option.initiation, *start)
        option.mature = True
    for end in effects:
        option.effects.append(np.array(end, dtype=np.float64))
    for outcome in record:
        option.record.append(outcome)
        option.n_runs += 1
        option.n_successes += outcome
    return option


def event(index: int, *center: float, radius: float = 1.0) -> Event:
    return Event(f"e{index}", np.array(center), radius)


class World:
    """A graph with all that plans and acts on it, to be filled by hand. Goal space is the plane, the radius 1."""

    def __init__(self, *, reach: int = 20, nearest: Any = "steps", timeout: int = 10, **graph_kwargs: Any) -> None:
        self.graph = SkillGraph(2, **{**PLAIN_WEIGHTS, **graph_kwargs})
        self.visited = VisitedStates(2, 0.25)
        self.planner = GraphPlanner(self.graph, self.visited, 1.0, reach, nearest)
        self.made: list[Option] = []
        self.matured: list[str] = []
        self.chaining = DeepSkillChaining(
            self.graph,
            self._make,
            lambda option: self.matured.append(option.id),
            gestation_period=3,
            practice_runs=0,
            max_failures=4,
        )
        self.global_option = make_option("global", None, None, seed=0)
        self.controller = Controller(
            self.global_option, self.chaining, self.planner, ScaledView(relative_view, 1.0), 1.0, 0.5, timeout, False, None
        )
        self.clock = 0

    def _make(self, id: str, target: str, termination: TerminationSet) -> Option:
        option = make_option(id, target, termination, seed=len(self.made) % 3 + 1)
        self.made.append(option)
        return option

    def add_event(self, *center: float) -> Event:
        added = event(len(self.graph.events), *center)
        self.graph.add_event(added)
        events = list(self.graph.events.values())
        self.visited.set_events(np.stack([e.center for e in events]), np.array([e.radius for e in events]))
        return added

    def add_option(
        self,
        target: Event,
        start: Sequence[float],
        *,
        start_radius: float = 3.0,
        successes: int = 8,
        failures: int = 0,
    ) -> Option:
        """A mature option from the disc around ``start`` to an event, with effects in the event's centre."""
        index = len(self.chaining.options) + 1
        option = make_option(
            f"o{index}",
            target.id,
            target,
            start=(start, start_radius),
            effects=[target.center] * successes,
            record=[True] * successes + [False] * failures,
            seed=index % 3 + 1,
        )
        self.chaining.options[option.id] = option
        self.graph.add_option(option)
        return option

    def walk(self, start: Sequence[float], end: Sequence[float], n_steps: int) -> None:
        """Record one trajectory straight from one point to another, ``n_steps`` long."""
        self.tour([start, end], n_steps)

    def tour(self, corners: Sequence[Sequence[float]], n_steps: int) -> None:
        """Record one trajectory around some corners, ``n_steps`` from each to the next."""
        n_total = n_steps * (len(corners) - 1)
        for t in range(n_total + 1):
            point = [np.interp(t / n_steps, range(len(corners)), xs) for xs in zip(*corners, strict=True)]
            self.visited.record(0, self.clock, np.array(point, dtype=np.float32), done=t == n_total)
            self.clock += 1

    def line(self) -> None:
        """Events at x = 0, 10, 20, options there (o1: e0 to e1, o2: e1 to e2) and back (o3, o4), walked both ways."""
        events = [self.add_event(x, 0.0) for x in (0.0, 10.0, 20.0)]
        for start, end in ((0, 1), (1, 2), (2, 1), (1, 0)):
            self.add_option(events[end], events[start].center.tolist())
        self.walk((0, 0), (20, 0), 40)
        self.walk((20, 0), (0, 0), 40)
