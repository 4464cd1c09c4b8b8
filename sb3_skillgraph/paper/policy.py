"""Which option runs, by the paper: the planner's inside the graph, the policy over options outside (3.2.3, 3.2.4, A.6)."""

import math

import numpy as np

from sb3_skillgraph.options.option import Option
from sb3_skillgraph.paper.chaining import DeepSkillChaining
from sb3_skillgraph.paper.graph import PaperGraph
from sb3_skillgraph.plan import Plan, Status, from_here, remaining_steps
from sb3_skillgraph.planning import DIRECT, GOAL, TIME_BINS, Planner
from sb3_skillgraph.runner import Chosen
from sb3_skillgraph.running import RunnerState


class PaperPolicy:
    """Chooses options.

    Inside the graph, where a path leads to the goal, it is the first option of the cheapest one. Else it is that of the path
    to the event nearest to the goal; and from there on, and outside the graph, the policy over options of deep skill
    chaining. A.6 leaves open which that is; here it is the earliest admissible option of the chains that lead to the goal's
    event, as in the authors' later work (Bagaria et al. 2021), and for a goal without a chain the option that leads nearest
    to it.

    :param graph: the skill graph
    :param chaining: the chains
    :param timeout: environment steps an option may run
    :param planner: knows within how many environment steps a goal is to be reached
    """

    def __init__(self, graph: PaperGraph, chaining: DeepSkillChaining, timeout: int, planner: Planner) -> None:
        self.graph = graph
        self.chaining = chaining
        self.timeout = timeout
        self.planner = planner

    def choose(self, state: RunnerState, i: int, point: np.ndarray, goal: np.ndarray, stance: float) -> Chosen:
        """Choose the option that runs next.

        :param state: the state before the step
        :param i: the environment
        :param point: where its agent stands, shape ``(goal_dim,)``
        :param goal: where it is to go, same shape
        :param stance: not used
        """
        way = self.way(state, i, point, goal)
        option = self.outside(point, goal) if way is None else self.chaining.options[way[0]]
        event = self._here(point, goal)
        if option is None:
            return Chosen(DIRECT, event, goal, self.timeout)
        return Chosen(option.id, event, option.subgoal, self.timeout)

    def way(self, state: RunnerState, i: int, point: np.ndarray, goal: np.ndarray) -> list[str] | None:
        """Return the way that is planned: to the goal, else to the event nearest to it; None if there is none to go.

        Whoever has been at the nearest event and left it from there has left the graph.

        :param state: tells the runs so far
        :param i: the environment
        :param point: where its agent stands, shape ``(goal_dim,)``
        :param goal: shape ``(goal_dim,)``
        """
        running = str(state.option[i])
        able = [option.id for option in self.graph.options.values() if not running and option.can_start(point)]
        if running in self.graph.options:
            able = [running]
        costs, ways = self.graph.ways_from(able)
        ends = [vertex for vertex in self._targets(goal) if vertex in costs]
        if ends:
            return [*ways[min(ends, key=lambda vertex: costs[vertex] + self._runs(vertex))], GOAL]
        here = self._here(point, goal)
        known = [event for event in self.graph.events if event.id in costs or event.id == here]
        if not known:
            return None
        nearest = min(known, key=lambda event: math.dist(event.center, goal)).id
        if nearest == here or nearest in state.run_event[i]:
            return None
        return ways[nearest]

    def _here(self, point: np.ndarray, goal: np.ndarray) -> str:
        """Return the event that holds a point, of several the one nearest to the goal; an empty string if there is none."""
        events = self.graph.events_at(point)
        return min(events, key=lambda event: math.dist(event.center, goal)).id if events else ""

    def _runs(self, vertex: str) -> float:
        """Return how often an option at the end of a path is to be run; no edge says so."""
        return 1.0 / max(self.chaining.options[vertex].success_rate, 1e-3) if vertex in self.chaining.options else 0.0

    def _targets(self, goal: np.ndarray) -> list[str]:
        """Return the vertices at which a goal is reached, or from which a chain that has begun inside goes on to it."""
        target = self.graph.id(self.graph.locate(goal))
        chains = self.chaining.leading_to(target) if target else []
        return [*self.graph.inside(goal), *(chain.options[0] for chain in chains if chain.options[0] in self.graph.options)]

    def outside(self, point: np.ndarray, goal: np.ndarray) -> Option | None:
        """Return what the policy over options of deep skill chaining runs; None if there are no options yet.

        :param point: where the agent stands, shape ``(goal_dim,)``
        :param goal: where it is to go, same shape
        """
        for chain in self.chaining.leading_to(self.graph.id(self.graph.locate(goal))):
            option = self.chaining.admissible(chain, point)
            if option is not None:
                return option
        options = [option for option in self.chaining.options.values() if not option.terminates(point)]
        able = [option for option in options if option.can_start(point)]
        return min(able or options, key=lambda option: math.dist(option.subgoal, goal), default=None)

    # -- plans for people ---------------------------------------------------------------------------------------------

    def plan(self, state: RunnerState, point: np.ndarray, goal: np.ndarray) -> Plan:
        """Tell how the agent goes about a goal.

        :param state: of one environment, advanced to this step
        :param point: where the agent stands, shape ``(goal_dim,)``
        :param goal: shape ``(goal_dim,)``
        :return: the plan; its path is empty where the policy over options decides
        """
        way, status = self.way(state, 0, point, goal) or [], self._status(goal)
        if GOAL not in way:
            return PaperPlan(status, tuple(way), float(self.planner.horizon), 0.0)
        steps, probability = self.worth(way, remaining_steps(state, self.planner.horizon))
        return PaperPlan(status, tuple(way), from_here(state, steps), probability)

    def worth(self, vertices: list[str], remaining: float) -> tuple[float, float]:
        """Tell what a way is worth, if a failed option is run again.

        :param vertices: ids
        :param remaining: environment steps that are left
        :return: expected environment steps until every option has succeeded (all of them, where one never did), and the
            probability that this is within those that are left
        """
        options = [self.chaining.options[vertex] for vertex in vertices if vertex in self.chaining.options]
        if not all(option.n_successes for option in options):
            return float(self.planner.horizon), 0.0
        arrived = np.zeros(TIME_BINS + 1)  # by time bin, the probability to be done with the options so far
        arrived[0] = 1.0
        for option in options:
            delay = max(round(option.n_steps / option.n_runs / remaining * TIME_BINS), 1)
            begun, arrived = arrived, np.zeros_like(arrived)
            for t in range(TIME_BINS + 1 - delay):
                arrived[t + delay] += option.success_rate * begun[t]
                begun[t + delay] += (1.0 - option.success_rate) * begun[t]
        steps = sum(option.n_steps / option.n_successes for option in options)
        return min(steps, float(self.planner.horizon)), float(arrived.sum())

    def links_from(self, event: str) -> list[tuple[str, str, float, float]]:
        """Return the ways from an event to others that pass no third one.

        :param event: its id
        :return: for each, both ids, its probability and its environment steps
        """
        links = []
        for target, way in self.graph.ways_past_no_event(event).items():
            steps, probability = self.worth(way, self.planner.horizon)
            links.append((event, target, probability, steps))
        return links

    def _status(self, goal: np.ndarray) -> Status:
        if self.graph.inside(goal):
            return "in_graph"
        return "in_initiation_set" if self.graph.holding(goal) else "outside"


class PaperPlan(Plan):
    """A plan over the paper's graph: every vertex on the way, options and events."""

    def __str__(self) -> str:
        if not self.path:
            return f"The goal is {self.status.replace('_', ' ')}: the policy over options goes there."
        way = ", ".join(self.path[: -1 if self.path[-1] == GOAL else None])
        if self.path[-1] != GOAL:
            return f"The goal is {self.status.replace('_', ' ')}: go near it by way of {way}; the policy over options goes on."
        return (
            f"The goal is {self.status.replace('_', ' ')}: go there by way of {way}, about {self.expected_steps:.0f} steps, "
            f"success {self.success_probability:.0%}."
        )
