"""Plans: the way to a goal that costs the fewest environment steps, by what options have done (sections 3.2.4, 3.3)."""

from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array

from sb3_skillgraph.choices import NO_RUNS, ChoiceModel, Choices, Runs, Stance, Start
from sb3_skillgraph.graph import NOWHERE, SkillGraph
from sb3_skillgraph.walk_model import WalkModel

#: Id of the option that walks to the goal itself.
DIRECT = "direct"
#: Vertex id of a goal, at the end of a path.
GOAL = "goal"
#: Being lost costs so many horizons: to arrive within the episode comes first, a short way second.
LOST_HORIZONS = 10.0
#: Environment steps by which values may still change when value iteration ends; sweeps, at most.
PRECISION, MAX_SWEEPS = 0.5, 300
#: Bins of time in which the success within the horizon is worked out.
TIME_BINS = 200
#: Values that are remembered, until something is learned or happens.
MEMORY = 32


def timeout(steps: float | np.ndarray) -> float | np.ndarray:
    """Return the environment steps that a run may take which is expected to succeed in ``steps``."""
    return 2.0 * steps + 15.0


class Solution(NamedTuple):
    """The values of all vertices, and the choices they rest on.

    :param choices: of all vertices; those of the start come last
    :param values: environment steps to the goal from each event, the goal (0), the start, and nowhere (lost)
    :param costs: the same by way of each choice, shape ``(n_choices,)``
    """

    choices: Choices
    values: np.ndarray
    costs: np.ndarray

    @property
    def goal(self) -> int:
        """The goal's vertex."""
        return len(self.values) - 3

    @property
    def start(self) -> int:
        """The vertex where the plan begins."""
        return len(self.values) - 2

    def first(self) -> int:
        """Return the choice at the start; of equals the walk to the goal, else the first."""
        rows = np.flatnonzero(self.choices.source == self.start)
        cheapest = rows[self.costs[rows] <= self.costs[rows].min()]
        direct = cheapest[self.choices.target[cheapest] == self.goal]
        return int(direct[0] if len(direct) else cheapest[0])

    def best(self) -> np.ndarray:
        """Return the choice at each vertex, shape of ``values``; ``-1`` where there is none, the first of equals."""
        best = np.full(len(self.values), -1)
        rows = np.lexsort((-np.arange(len(self.costs)), -self.costs))  # the cheapest is written last
        best[self.choices.source[rows]] = rows
        return best


class Planner:
    """Finds the cheapest way to a goal over the skill graph.

    :param graph: the skill graph
    :param model: what to expect of walks that have not been tried
    :param horizon: environment steps within which a goal is to be reached
    """

    def __init__(self, graph: SkillGraph, model: WalkModel, horizon: int) -> None:
        self.graph = graph
        self.choice_model = ChoiceModel(graph, model)
        self.horizon = horizon
        self.lost = LOST_HORIZONS * horizon
        self._memory: dict[tuple[object, ...], Solution] = {}

    def solve(self, start: Start, goal: np.ndarray, runs: Runs = NO_RUNS, stance: Stance = Stance.PESSIMISTIC) -> Solution:
        """Work out what it costs to get to a goal, by value iteration.

        It is a function of the graph and what is given here, and of nothing else. Time: sweeps, about as many as a way
        has options, of one product of a sparse matrix each.

        :param start: where the agent stands
        :param goal: shape ``(goal_dim,)``
        :param runs: what has happened in this episode
        :param stance: what to count on
        """
        versions = self.graph.version, self.choice_model.model.version
        key = (*versions, stance, start.event, start.point.tobytes(), goal.tobytes(), *(c.tobytes() for c in runs))
        if key not in self._memory:
            if len(self._memory) >= MEMORY:
                self._memory.clear()
            self._memory[key] = self._solve(self.choice_model.choices(start, goal, runs, stance))
        return self._memory[key]

    def _solve(self, choices: Choices) -> Solution:
        """Iterate from above: everything is lost, but for the goal; what a sweep finds is a way that can be gone."""
        n_events = len(self.graph.events)
        constant, matrix = self._as_linear(choices, n_events + 3)
        order = np.argsort(choices.source, kind="stable")
        sources, first = np.unique(choices.source[order], return_index=True)
        constant, matrix = constant[order], matrix[order]
        values = np.full(n_events + 3, self.lost)
        values[n_events] = 0.0
        for _ in range(MAX_SWEEPS):
            costs = np.minimum(constant + matrix @ values, self.lost)
            before = values[sources]
            values[sources] = np.minimum.reduceat(costs, first)
            if (before - values[sources]).max(initial=0.0) < PRECISION:
                break
        in_order = np.empty_like(costs)
        in_order[order] = costs
        return Solution(choices, values, in_order)

    def _as_linear(self, choices: Choices, n_vertices: int) -> tuple[np.ndarray, csr_array]:
        """Return what each choice costs by itself, and the probabilities of where it ends.

        Runs that end where they began are repeated: what is returned is of the run that gets somewhere.
        """
        failure = 1.0 - choices.success
        steps = choices.success * choices.steps + failure * timeout(choices.steps)
        shares = failure[:, None] * choices.share
        stays = choices.landing == choices.source[:, None]
        goes = np.maximum(1.0 - (shares * stays).sum(axis=1), 1e-9)
        shares = np.where(stays, 0.0, shares)
        ends = np.concatenate([choices.target[:, None], choices.landing], axis=1) % n_vertices
        probabilities = np.concatenate([choices.success[:, None], shares], axis=1) / goes[:, None]
        # Sparse: most choices end in two or three vertices.
        rows, columns = np.nonzero(probabilities)
        entries = probabilities[rows, columns], (rows, ends[rows, columns])
        return steps / goes, csr_array(entries, shape=(len(steps), n_vertices))

    # -- what a plan is -----------------------------------------------------------------------------------------------

    def path(self, solution: Solution, first: int) -> list[int]:
        """Follow a plan: the choices from the start to the goal, along the likeliest landing of lower value.

        :param solution: of the goal
        :param first: the choice at the start
        :return: row numbers of choices; no vertex comes twice
        """
        choices, values, best = solution.choices, solution.values, solution.best()
        row, rows = first, [first]
        value = np.inf  # whatever the first option is: it runs
        while choices.target[row] != solution.goal:
            ends = np.append(choices.landing[row], choices.target[row])
            weight = np.append((1.0 - choices.success[row]) * choices.share[row], choices.success[row])
            weight[values[ends] >= value] = 0.0
            weight[ends == NOWHERE] = 0.0
            if not weight.any():
                break
            vertex = int(ends[weight.argmax()])
            value = values[vertex]
            row = int(best[vertex])
            if row < 0 or value >= self.lost:
                break
            rows.append(row)
        return rows

    def promise(self, start: Start, goal: np.ndarray, runs: Runs, acting: Solution, first: int, remaining: float) -> tuple[float, float]:
        """Tell what a plan is worth, by what is expected of options rather than what is counted on.

        :param start: where the agent stands
        :param goal: shape ``(goal_dim,)``
        :param runs: what has happened in this episode
        :param acting: the solution that choices are made by
        :param first: the choice at the start
        :param remaining: environment steps that are left
        :return: probability that the goal is reached within them, and expected steps if it is
        """
        expected = self.choice_model.choices(start, goal, runs, Stance.EXPECTED)
        best = acting.best()
        best[acting.start] = first
        policy = expected.take(best[best >= 0])
        width = remaining / TIME_BINS
        # reached[t, v]: probability to be at the goal within t bins from v.
        n = len(acting.values)
        reached = np.zeros((TIME_BINS + 1, n))
        reached[:, acting.goal] = 1.0
        delay = np.concatenate(
            [policy.steps[:, None], np.repeat(timeout(policy.steps)[:, None], policy.landing.shape[1], axis=1)], axis=1
        )
        ends = np.concatenate([policy.target[:, None], policy.landing], axis=1) % n
        weight = np.concatenate([policy.success[:, None], (1.0 - policy.success)[:, None] * policy.share], axis=1)
        for t in range(1, TIME_BINS + 1):
            # In between two bins in proportion; a run takes one at least.
            at = np.clip(t - np.maximum(delay / width, 1e-3), -1.0, t - 1e-3)
            low = np.floor(at).astype(np.int64)
            part = at - low
            below = np.where(low >= 0, reached[np.maximum(low, 0), ends], 0.0)
            above = np.where(low + 1 >= 0, reached[np.clip(low + 1, 0, t - 1), ends], 0.0)
            value = (1.0 - part) * below + part * above
            reached[t, policy.source] = (weight * value).sum(axis=1)
        curve = reached[:, acting.start]
        probability = float(curve[-1])
        steps = float(((np.arange(1, TIME_BINS + 1) - 0.5) * np.diff(curve)).sum() * width / max(probability, 1e-9))
        return probability, steps
