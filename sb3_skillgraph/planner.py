"""Planning over the skill graph: to an event, and to a goal the agent never saw (sections 3.2.3, 3.2.4, 3.3)."""

from collections.abc import Callable, Collection
from typing import Literal, NamedTuple

import numpy as np

from sb3_skillgraph.events import SalientEvent
from sb3_skillgraph.graph import GraphPath, SkillGraph
from sb3_skillgraph.visited import BACKWARDS, VisitedStates

_Table = Callable[[np.ndarray, float, tuple[int, ...]], dict[int, int]]
Status = Literal["in_graph", "in_initiation_set", "outside"]


RETRACING = 2.0  # option runs that a long way retraced costs per option run's length


class Plan(NamedTuple):
    """How the agent would go about a goal.

    :param status: the paper's three cases (Figure 2): ``in_graph`` (the goal region holds the effect set of an option,
        or a salient event's centre), ``in_initiation_set`` (an option could start from the goal), ``outside``
    :param path: ids of the vertices on the way; the global option walks what remains. Empty if no path leads there
    :param cost: sum of the edges' weights, ``inf`` without a path
    :param success_probability: product of the edges' success rates, 0 without a path
    """

    status: Status
    path: tuple[str, ...]
    cost: float
    success_probability: float


class Leg(NamedTuple):
    """One candidate way to a goal: to an event over the graph (None: straight from here), then straight on.

    :param event: the event to leave the graph at
    :param path: the way there, None when standing in it
    :param cost: path and last leg together, in option runs
    """

    event: str | None
    path: GraphPath | None
    cost: float


class GraphPlanner:
    """Finds ways through the skill graph.

    :param graph: the graph
    :param visited: the agent's trajectories, which tell how near in steps two places are
    :param radius: the event radius, in goal units
    :param reach: steps a single option usually covers; a last leg of that length costs as much as one option run
    :param nearest: how the vertex nearest to a goal is found: ``steps`` along trajectories, or the paper's
        ``euclidean`` distance (section 3.2.3)
    """

    def __init__(
        self, graph: SkillGraph, visited: VisitedStates, radius: float, reach: int, nearest: Literal["steps", "euclidean"]
    ) -> None:
        self.graph = graph
        self.visited = visited
        self.radius = radius
        self.reach = reach
        self.nearest = nearest
        # Of a trajectory to be followed: from where one stands it can be reached; but it must end at the goal.
        self._passing = (radius, 0.5 * radius)

    def event_at(self, point: np.ndarray) -> SalientEvent | None:
        """Return the event a point lies in (the nearest, if several)."""
        label = int(self.visited.label(np.asarray(point)[None])[0])
        return None if label < 0 else self.graph.events[f"e{label}"]

    def path_to(self, point: np.ndarray, vertex: str, avoid: Collection[str] = ()) -> GraphPath | None:
        """Find the cheapest way to a vertex that can be started from a point.

        :param point: where the agent stands, shape ``(goal_dim,)``
        :param vertex: id of the vertex
        :param avoid: ids of options that have failed lately; they are run only if nothing else leads there
        """
        useful = self.graph.useful(point)
        detour = self.graph.path_on(self.graph.ways_from(useful, avoid), vertex) if avoid else None
        return detour or self.graph.shortest_path(useful, vertex)

    def vertices_near(self, goal: np.ndarray) -> list[tuple[SalientEvent, float]]:
        """Rank the events from which a goal is near, nearest first (section 3.2.3).

        :param goal: shape ``(goal_dim,)``
        :return: events and distances: steps, as trajectories passed them on the way to the goal (or, less surely, came
            back from it), or goal units if ``nearest`` is ``euclidean``
        """
        # An event that nothing leads to, as that of a goal being adapted to may be, is none to leave the graph at.
        events = self.graph.event_bank.holding(goal)
        without = tuple(int(event.id[1:]) for event in events if self.graph.nx.in_degree(event.id) == 0)
        return self._ranked(goal, self.visited.events_before, self.visited.events_after, without)

    def _ranked(
        self, point: np.ndarray, seen: _Table, reversed_: _Table, without: tuple[int, ...] = ()
    ) -> list[tuple[SalientEvent, float]]:
        if self.nearest == "euclidean" or self.visited.size == 0:
            distances = [(event, float(np.linalg.norm(event.center - point))) for event in self.graph.events.values()]
        else:
            steps: dict[int, float] = {}
            for table, doubt in ((seen, 1.0), (reversed_, BACKWARDS)):
                for index, n in table(point, self.radius, without).items():
                    steps[index] = min(steps.get(index, np.inf), doubt * n)
            distances = [(self.graph.events[f"e{index}"], n) for index, n in steps.items()]
        return sorted(distances, key=lambda pair: pair[1])

    def legs(self, point: np.ndarray, goal: np.ndarray, avoid: Collection[str] = ()) -> list[Leg]:
        """List the ways to a goal, cheapest first.

        :param point: where the agent stands, shape ``(goal_dim,)``
        :param goal: shape ``(goal_dim,)``
        :param avoid: ids of options that have failed lately
        """
        unit = self.reach if self.nearest == "steps" else 2.0 * self.radius
        legs = []
        steps = self.visited.steps_between(point, goal, self._passing)
        if np.isfinite(steps) and self.nearest == "steps":
            # Beyond the reach of one option, plans are surer than a long way retraced.
            legs.append(Leg(None, None, steps / self.reach * (1.0 if steps <= self.reach else RETRACING)))
        tree = self.graph.ways_from(self.graph.useful(point), avoid)
        for event, distance in self.vertices_near(goal):
            if event.holds(point):
                legs.append(Leg(None, None, distance / unit))
            elif (path := self.graph.path_on(tree, event.id)) is not None:
                legs.append(Leg(event.id, path, path.cost + distance / unit))
        return sorted(legs, key=lambda leg: leg.cost)

    def waypoint(self, point: np.ndarray, goal: np.ndarray, failures: int) -> int:
        """Return the next point on the way that a trajectory took from near one point to near another.

        The global option sees no walls; it is sent along ways that have been gone before, a stretch at a time.

        :param point: where the agent stands, shape ``(goal_dim,)``
        :param goal: shape ``(goal_dim,)``
        :param failures: approaches that have failed; after one, stretches are shorter
        :return: number of a visited point; ``-1`` for the goal itself
        """
        if self.nearest == "euclidean":
            return -1
        return self.visited.waypoint(point, goal, self._passing, self.reach // (6 if failures else 3))

    def route(self, point: np.ndarray, goal: np.ndarray) -> np.ndarray:
        """Return where the global option should go first on its way to a goal (see :meth:`waypoint`).

        :param point: where the agent stands, shape ``(goal_dim,)``
        :param goal: shape ``(goal_dim,)``
        :return: a visited point, or the goal itself
        """
        waypoint = self.waypoint(point, goal, 0)
        return goal if waypoint < 0 else self.visited.point(waypoint)

    def entry(self, point: np.ndarray, target: str | None) -> SalientEvent | None:
        """Return the event by which to enter the graph from a point outside.

        :param point: where the agent stands, shape ``(goal_dim,)``
        :param target: id of the vertex to be reached from there; None for any
        :return: the event reached soonest of those from which a path leads on; None if there is none
        """
        ways = self.graph.events if target is None else self.graph.ways_to(target)
        for event, _ in self._ranked(point, self.visited.events_after, self.visited.events_before):
            if event.id in ways and not event.holds(point):
                return event
        return None

    def status(self, goal: np.ndarray, radius: float) -> Status:
        """Tell which of the paper's three cases a goal is (section 3.3, Figure 2).

        :param goal: shape ``(goal_dim,)``
        :param radius: radius of the goal region, in goal units
        """
        region = SalientEvent("goal", goal, radius)
        if self.graph.ending_in(region) or any(region.holds(event.center) for event in self.graph.events.values()):
            return "in_graph"
        return "in_initiation_set" if self.graph.startable(goal) else "outside"

    def plan(self, point: np.ndarray, goal: np.ndarray, radius: float) -> Plan:
        """Plan from a point to a goal.

        :param point: where the agent stands, shape ``(goal_dim,)``
        :param goal: shape ``(goal_dim,)``
        :param radius: radius of the goal region, in goal units
        """
        status = self.status(goal, radius)
        legs = self.legs(point, goal)
        if not legs:
            return Plan(status, (), float("inf"), 0.0)
        path = legs[0].path
        if path is None:
            here = self.event_at(point)
            return Plan(status, (), float("inf"), 0.0) if here is None else Plan(status, (here.id,), 0.0, 1.0)
        return Plan(status, path.vertices, path.cost, path.success_probability)

    def coverage(self, n_samples: int = 500) -> float:
        """Return the share of visited states from which some vertex can be entered: by an option, or by being in an event.

        :param n_samples: how many visited states are looked at, evenly spread over the memory
        """
        if self.visited.size == 0:
            return 0.0
        points = self.visited.points[np.linspace(0, self.visited.size - 1, n_samples).astype(int)]
        _, startable = self.graph.option_bank.startable(points)
        return float(((self.visited.label(points) >= 0) | startable.any(axis=1)).mean())
