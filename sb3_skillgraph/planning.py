"""Plans: the way to a goal that costs the fewest environment steps, by what options have done (sections 3.2.4, 3.3)."""

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sb3_skillgraph.choice_model import ChoiceModel
from sb3_skillgraph.choices import EXPECTED, NO_RUNS, PESSIMISTIC, Choices, Runs, Start
from sb3_skillgraph.edges import NOWHERE
from sb3_skillgraph.graph import SkillGraph
from sb3_skillgraph.walk_model import WalkModel

if TYPE_CHECKING:
    from scipy.sparse import csr_array

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
#: Share of the failures that will happen again and again, of an option that always fails: what a policy without noise cannot
#: do from some place it never can. Of one that seldom fails it is less, in proportion.
FOR_GOOD = 0.06
#: The same of walks to a goal where nobody has ever been: often there is a wall before it.
FOR_GOOD_OUTSIDE = 0.3
#: Probability that a plan promises at least: nothing is impossible.
LEAST = 1e-6
#: Opinions of how well options do, in standard deviations: two thirds as far apart as the fifths of a normal distribution,
#: since some of what is not known of each is its own and evens out.
OPINIONS = (-0.84, -0.34, 0.0, 0.34, 0.84)
#: Runs, of all walks together, with which opinions lie twice as far apart: then nearly all is guessed, by one model of untried
#: walks, and what is wrong with it evens out no more. At most so many times as far: then any rate is some opinion.
FEW_RUNS, FARTHEST = 10.0, 3.0


class Linear(NamedTuple):
    """What choices cost, as a linear function of the values of all vertices.

    :param constant: environment steps that they take themselves, shape ``(n,)``
    :param matrix: probabilities of where they end, shape ``(n, n_vertices)``
    """

    constant: np.ndarray
    matrix: "csr_array"

    @classmethod
    def of(cls, choices: Choices, stance: float, n_vertices: int) -> "Linear":
        """Work out choices.

        Runs that end where they began are repeated: what is returned is of the run that gets somewhere.

        :param choices: what can be done
        :param stance: what to count on, in standard deviations above what is expected
        :param n_vertices: number of all vertices
        """
        from scipy.sparse import csr_array  # when it is used: it takes a while to import

        ends, probability = choices.outcomes(stance)
        success = probability[:, 0]
        steps = success * choices.steps + (1.0 - success) * choices.failed_steps
        stays = ends == choices.source[:, None]
        goes = np.maximum(1.0 - (probability * stays).sum(axis=1), 1e-9)
        probability[stays] = 0.0
        probability /= goes[:, None]
        # Sparse: most choices end in two or three vertices.
        rows, columns = np.nonzero(probability)
        entries = probability[rows, columns], (rows, ends[rows, columns] % n_vertices)
        return cls(steps / goes, csr_array(entries, shape=(len(steps), n_vertices)))

    def costs(self, values: np.ndarray) -> np.ndarray:
        """Return what each choice costs.

        :param values: of all vertices
        """
        return self.constant + self.matrix @ values


class Solution(NamedTuple):
    """The values of all vertices, and what can be done on the way.

    :param values: environment steps to the goal from each event, the goal (0), the start, and nowhere (lost)
    :param walks: what training has shown of each edge of the graph
    :param walk_costs: steps to the goal by way of each; infinite where the episode has shown more
    :param episode: what the episode adds; what can be done at the start comes last
    :param episode_costs: the same for these
    """

    values: np.ndarray
    walks: Choices
    walk_costs: np.ndarray
    episode: Choices
    episode_costs: np.ndarray

    @property
    def goal(self) -> int:
        """The goal's vertex."""
        return len(self.values) - 3

    @property
    def start(self) -> int:
        """The vertex where the plan begins."""
        return len(self.values) - 2

    @property
    def choices(self) -> Choices:
        """All that can be done: the walks, then what the episode adds."""
        return Choices.join([self.walks, self.episode])

    def first(self) -> int:
        """Return the row, among those of the episode, of the first option: of equals the walk to the goal, else the first."""
        rows = np.flatnonzero(self.episode.source == self.start)
        cheapest = rows[self.episode_costs[rows] <= self.episode_costs[rows].min()]
        direct = cheapest[self.episode.target[cheapest] == self.goal]
        return int(direct[0] if len(direct) else cheapest[0])

    def second(self) -> int | None:
        """Return the row of the cheapest option at the start that leads elsewhere than the first one; None if none does."""
        first = self.episode.target[self.first()]
        rows = np.flatnonzero((self.episode.source == self.start) & (self.episode.target != first))
        return int(rows[self.episode_costs[rows].argmin()]) if len(rows) else None

    def leading_to(self, target: int) -> int:
        """Return the row, among those of the episode, of the choice at the start that leads to a vertex."""
        return int(np.flatnonzero((self.episode.source == self.start) & (self.episode.target == target))[0])

    def best(self, first: int) -> np.ndarray:
        """Return the row of the choice at each vertex, shape of ``values``: the cheapest, the first of equals.

        :param first: the row, among those of the episode, of the choice at the start
        :return: rows of ``choices``; ``-1`` where there is none
        """
        source = np.concatenate([self.walks.source, self.episode.source])
        costs = np.concatenate([self.walk_costs, self.episode_costs])
        best = np.full(len(self.values), -1)
        rows = np.lexsort((-np.arange(len(costs)), -costs))  # the cheapest is written last
        best[source[rows]] = rows
        best[self.start] = len(self.walk_costs) + first
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
        self._known: dict[float, tuple[tuple[Any, int], Linear]] = {}

    @property
    def lost(self) -> float:
        """What it costs to be lost, in environment steps."""
        return LOST_HORIZONS * self.horizon

    def solve(
        self,
        start: Start,
        goal: np.ndarray,
        runs: Runs = NO_RUNS,
        stance: float = PESSIMISTIC,
        everywhere: bool = False,
    ) -> Solution:
        """Work out what it costs to get to a goal, by value iteration.

        It begins from above: everything is lost, but for the goal; what a sweep finds is a way that can be gone. The
        result is a function of the graph and what is given here, and of nothing else. Time: sweeps, about as many as a
        way has options, of one product of a sparse matrix each.

        :param start: where the agent stands
        :param goal: shape ``(goal_dim,)``
        :param runs: what has happened in this episode
        :param stance: what to count on, in standard deviations above what is expected
        :param everywhere: whether walks straight to the goal are considered from all events, however far away
        """
        n_events = len(self.graph.events)
        n_vertices = n_events + 3
        known, walks = self._worked_out(stance), self.choice_model.walks()
        # Edges that the episode has shown more of stand among its own choices, and not among those of training
        replaced, episode = self.choice_model.of_episode(start, goal, runs, everywhere)
        known = known._replace(constant=known.constant.copy())
        known.constant[replaced] = np.inf
        linear = Linear.of(episode, stance, n_vertices)
        values = np.full(n_vertices, self.lost)
        values[n_events] = 0.0
        for _ in range(MAX_SWEEPS):
            before = values
            # One sweep: every vertex takes its cheapest choice, by the values of the last sweep
            values = np.full(n_vertices, self.lost)
            costs, episode_costs = known.costs(before), linear.costs(before)
            np.minimum.at(values, walks.source, costs)
            np.minimum.at(values, episode.source, episode_costs)
            values[n_events] = 0.0
            if (before - values).max() < PRECISION:
                break
        costs = np.minimum(costs, self.lost)
        costs[replaced] = np.inf
        return Solution(values, walks, costs, episode, np.minimum(episode_costs, self.lost))

    def _worked_out(self, stance: float) -> Linear:
        """Return what training has shown as it costs; the same until something is learned."""
        version = self.choice_model.version
        if stance not in self._known or self._known[stance][0] != version:
            linear = Linear.of(self.choice_model.walks(), stance, len(self.graph.events) + 3)
            self._known[stance] = version, linear
        return self._known[stance][1]

    # -- what a plan is -----------------------------------------------------------------------------------------------

    def path(self, solution: Solution, first: int) -> list[tuple[int, int]]:
        """Follow a plan from the start to the goal, along the likeliest landing of lower value.

        :param solution: of the goal
        :param first: the row, among those of the episode, of the choice at the start
        :return: for each option the vertex that it leads to, and the one that it is followed to; no option comes twice
        """
        values, best, choices = solution.values, solution.best(first), solution.choices
        steps: list[tuple[int, int]] = []
        named: set[int] = set()
        vertex, value = solution.start, float(solution.episode_costs[first])
        while best[vertex] >= 0 and not (steps and values[vertex] >= self.lost):
            row = choices.take(best[[vertex]])
            target = int(row.target[0])
            if target in named:
                break
            named.add(target)
            if target == solution.goal:
                return [*steps, (target, target)]
            # Of the places where the option ends, the likeliest that is nearer to the goal
            ends, weight = (np.roll(column[0], -1) for column in row.outcomes(EXPECTED))  # of equals the target last
            weight[(values[ends] >= value) | (ends == NOWHERE) | (ends == solution.start)] = 0.0
            # An option that runs may be the best no more: then it is where it leads that counts.
            vertex = int(ends[weight.argmax()]) if weight.any() else target
            value = min(value, float(values[vertex]))
            steps.append((target, vertex))
        return [*steps, (solution.goal, solution.goal)]  # nothing leads on from there but to walk to the goal

    def promise(self, solution: Solution, first: int, remaining: float, outside: bool = False) -> tuple[float, float]:
        """Tell what a plan is worth, by what is expected of options rather than what is counted on.

        How well options do is not known for sure, and where they do worse than expected they do so again and again, all of
        them: the walker is then not as good. So the probability is worked out for several opinions of it, from the worst
        to the best, and averaged; where there have hardly been any runs they lie further apart.

        :param solution: the solution that choices are made by
        :param first: the row, among those of the episode, of the choice at the start
        :param remaining: environment steps that are left
        :param outside: whether the goal lies where nobody has been
        :return: probability that the goal is reached within them, and expected steps if it is (the plan's cost, where that is
            next to impossible)
        """
        best = solution.best(first)
        policy = solution.choices.take(best[best >= 0])
        policy = policy.take(self._met(policy, solution.start))
        apart = min(1.0 + FEW_RUNS / max(self.choice_model.model.n_runs, 1e-9), FARTHEST)
        for_good = np.where(outside & (policy.target == solution.goal), FOR_GOOD_OUTSIDE, FOR_GOOD)
        # By bins of time: who fails and tries again arrives later, perhaps too late
        arrivals = [self._arrival(policy, apart * opinion, for_good, solution, remaining) for opinion in OPINIONS]
        curve = np.mean(arrivals, axis=0)
        probability = float(curve[-1])
        if probability < LEAST:
            return LEAST, float(solution.episode_costs[first])
        steps = float(((np.arange(1, TIME_BINS + 1) - 0.5) * np.diff(curve)).sum() / probability)
        return min(probability, 1.0), steps * remaining / TIME_BINS

    @staticmethod
    def _met(policy: Choices, start: int) -> np.ndarray:
        """Return the rows of a policy that are met from a start on, however unlikely."""
        ends, probability = policy.outcomes(EXPECTED)
        ends[probability == 0.0] = NOWHERE
        met = policy.source == start
        while True:
            more = met | np.isin(policy.source, ends[met])
            if (more == met).all():
                return np.flatnonzero(met)
            met = more

    def _arrival(
        self, policy: Choices, stance: float, for_good: np.ndarray, solution: Solution, remaining: float
    ) -> np.ndarray:
        """Return the probability to have arrived at the goal from the start, within each number of time bins.

        To have arrived from a vertex within t bins is to end a run from there, in one of its ends, and to arrive from that
        within the bins that are left: the sum over the ends of their probability times ``arrived[t - delay, end]``.

        :param policy: the choice at each vertex
        :param stance: an opinion of how well options do
        :param for_good: share of the failures of each that happen again and again, if it always fails
        :param solution: says which vertices are goal and start
        :param remaining: environment steps of all bins together
        """
        width, n = remaining / TIME_BINS, len(solution.values)
        ends, weight = policy.outcomes(stance, for_good)
        ends %= n  # who is lost is at the last vertex
        # A run takes one bin at least, and otherwise its steps: between two bins it counts for both in proportion.
        delay = np.repeat(policy.failed_steps[:, None], ends.shape[1], axis=1)
        delay[:, 0] = policy.steps
        delay = np.maximum(delay / width, 1.0)
        whole = np.floor(delay).astype(np.int64)
        part = delay - whole
        # arrived[t, v]: probability to be at the goal within t bins from v; nobody is before the first one.
        arrived = np.zeros((TIME_BINS + 1, n))
        arrived[:, solution.goal] = 1.0
        for t in range(1, TIME_BINS + 1):
            before, earlier = t - whole, t - whole - 1
            value = np.where(before >= 0, (1.0 - part) * arrived[np.maximum(before, 0), ends], 0.0)
            value += np.where(earlier >= 0, part * arrived[np.maximum(earlier, 0), ends], 0.0)
            arrived[t, policy.source] = (weight * value).sum(axis=1)
        return arrived[:, solution.start]
