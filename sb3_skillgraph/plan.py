"""A plan as it is shown to people (section 3.3, Figure 2)."""

from typing import Literal, NamedTuple

import numpy as np

from sb3_skillgraph.choices import PESSIMISTIC
from sb3_skillgraph.edges import NOWHERE
from sb3_skillgraph.planning import DIRECT, GOAL, Solution
from sb3_skillgraph.runner import Runner
from sb3_skillgraph.running import RunnerState

Status = Literal["in_graph", "in_initiation_set", "outside"]

#: Events that a sentence names; of more the first three and the last two.
MOST_NAMED = 8


class Plan(NamedTuple):
    """How the agent goes about a goal.

    :param status: the paper's three cases: ``in_graph``, the goal lies where an option has been seen to end, in an event;
        ``in_initiation_set``, near enough to an event to belong to it; ``outside``, where the agent has never been
    :param path: ids of vertices: the option that runs first, where it leads, the option from there, ..., ``"goal"``
    :param expected_steps: environment steps from here to the goal, if it is reached
    :param success_probability: that it is reached within the horizon, failures and replanning included
    """

    status: Status
    path: tuple[str, ...]
    expected_steps: float
    success_probability: float

    def __str__(self) -> str:
        events = list(self.path[1:-1:2])
        if len(events) > MOST_NAMED:
            events[3:-2] = ["..."]
        by_way = f" by way of {', '.join(events)}" if events else " straight on"
        known = {
            "in_graph": "The goal lies in an event",
            "in_initiation_set": "The goal lies beside an event",
            "outside": "The goal lies where the agent has never been",
        }[self.status]
        steps = f"about {self.expected_steps:.0f} steps" if np.isfinite(self.expected_steps) else "no telling when"
        return f"{known}: go there{by_way}, {steps}, success {self.success_probability:.0%}."


def describe(runner: Runner, state: RunnerState, point: np.ndarray, goal: np.ndarray) -> Plan:
    """Make the plan that the runner follows.

    :param runner: runs options
    :param state: of one environment, advanced to this step
    :param point: where the agent stands, shape ``(goal_dim,)``
    :param goal: shape ``(goal_dim,)``
    :return: the plan; its first option is the one that runs, or would be begun
    """
    start = runner.start(state, 0, point)
    solution = runner.decide(state, 0, start, goal, PESSIMISTIC)
    first = solution.first() if start.towards == NOWHERE else solution.leading_to(start.towards)
    plan = _beginning_with(runner, solution, first, goal, remaining_steps(state, runner.planner.horizon))
    return plan._replace(expected_steps=from_here(state, plan.expected_steps))


def remaining_steps(state: RunnerState, horizon: int) -> float:
    """Return the environment steps that are left from where the first option began: if it runs, it has taken some of its own.

    :param state: of one environment
    :param horizon: environment steps of an episode
    """
    return max(horizon - float(state.elapsed[0] - state.steps[0]), 1.0)


def from_here(state: RunnerState, steps: float) -> float:
    """Return the environment steps from here, 1 at least.

    :param state: of one environment
    :param steps: those from where the first option began
    """
    return max(steps - float(state.steps[0]), 1.0)


def next_best(runner: Runner, point: np.ndarray, goal: np.ndarray) -> Plan | None:
    """Make the plan that would be the best if it were not for the first option of the one that is followed.

    :param runner: runs options
    :param point: where the agent stands at the start of an episode, shape ``(goal_dim,)``
    :param goal: shape ``(goal_dim,)``
    :return: the plan; None if there is nothing else to begin with
    """
    state = RunnerState.fresh(1, len(point), 0)
    solution = runner.decide(state, 0, runner.start(state, 0, point), goal, PESSIMISTIC)
    other = solution.second()
    return None if other is None else _beginning_with(runner, solution, other, goal, float(runner.planner.horizon))


def _beginning_with(runner: Runner, solution: Solution, first: int, goal: np.ndarray, remaining: float) -> Plan:
    status = _status(runner, goal)
    probability, steps = runner.planner.promise(solution, first, remaining, outside=status == "outside")
    return Plan(status, _ids(runner, solution, runner.planner.path(solution, first)), steps, probability)


def _ids(runner: Runner, solution: Solution, path: list[tuple[int, int]]) -> tuple[str, ...]:
    """Return the ids of the options of a path, and of the events that they are followed to."""
    graph = runner.graph
    ids: list[str] = []
    for target, landing in path:
        ids += [DIRECT, GOAL] if target == solution.goal else [graph.walk_ids[target], graph.id(landing)]
    return tuple(ids)


def _status(runner: Runner, goal: np.ndarray) -> Status:
    graph = runner.graph
    home = graph.locate(goal)
    if home == NOWHERE:
        return "outside"
    return "in_graph" if graph.events[home].holds(goal) else "in_initiation_set"
