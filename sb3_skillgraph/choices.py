"""What an agent could do in each event, and what would come of it: the model that plans are made on."""

from enum import Enum
from typing import NamedTuple

import numpy as np

from sb3_skillgraph.graph import NOWHERE, SkillGraph
from sb3_skillgraph.walk_model import Kind, WalkModel

#: Runs that the model's guess counts for, beside those that there were.
GUESS_RUNS = 2.0
#: Runs that one run of the running episode counts for: it began nearest in time and place, and without noise.
EPISODE_WEIGHT = 3.0
#: Events nearest to a goal, or to a start, from which it is considered to walk there though nobody was seen to.
NEAR_EVENTS = 6
#: Share of the success of a walk to an event that is left for a goal beside its centre.
BESIDE = 0.98


class Stance(Enum):
    """What to take for the success rate of an option, in standard deviations above its expectation."""

    OPTIMISTIC = 1.0
    EXPECTED = 0.0
    PESSIMISTIC = -0.5


class Runs(NamedTuple):
    """The runs of the running episode, as indices; arrays of shape ``(n,)``.

    :param source: event that they began in
    :param target: event that the walk led to; the number of events for the walk to the goal
    :param success: whether they got there
    :param landing: event in which they ended
    :param count: how many there were of each
    """

    source: np.ndarray
    target: np.ndarray
    success: np.ndarray
    landing: np.ndarray
    count: np.ndarray


NO_RUNS = Runs(*np.zeros((5, 0), dtype=np.int64))


class Start(NamedTuple):
    """Where a plan begins.

    :param point: shape ``(goal_dim,)``
    :param event: index of the event that the next option is begun in; ``NOWHERE`` if in none
    """

    point: np.ndarray
    event: int


class Choices(NamedTuple):
    """What can be done where, and what comes of it; one row for each.

    :param source: vertex where the option begins, shape ``(n,)``
    :param target: vertex where it leads
    :param success: probability of that
    :param steps: environment steps until then, if it succeeds
    :param landing: vertices where failed runs land, shape ``(n, m)``
    :param share: of the failures that land there, same shape; rows sum to 1
    """

    source: np.ndarray
    target: np.ndarray
    success: np.ndarray
    steps: np.ndarray
    landing: np.ndarray
    share: np.ndarray

    def take(self, rows: np.ndarray) -> "Choices":
        """Return some of the rows."""
        return Choices(*(column[rows] for column in self))

    @staticmethod
    def join(parts: list["Choices"]) -> "Choices":
        """Return the rows of all parts, one after the other."""
        return Choices(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


class Evidence(NamedTuple):
    """What is known of the success of some options; arrays of shape ``(n,)``, landings ``(n, MAX_LANDINGS)``.

    :param guess: success rate of their kind
    :param successes: weight of the runs that succeeded
    :param failures: weight of those that failed
    :param steps: environment steps of a successful run
    :param loss: share of the failures of their kind that end far away
    :param landing: events in which failed runs landed
    :param weight: weight of those
    """

    guess: np.ndarray
    successes: np.ndarray
    failures: np.ndarray
    steps: np.ndarray
    loss: np.ndarray
    landing: np.ndarray
    weight: np.ndarray

    def success(self, stance: Stance) -> np.ndarray:
        """Return the rate to count on: of the Beta distribution that guess and runs make, mean and deviation."""
        runs = GUESS_RUNS + self.successes + self.failures
        mean = (GUESS_RUNS * self.guess + self.successes) / runs
        return np.clip(mean + stance.value * np.sqrt(mean * (1.0 - mean) / (runs + 1.0)), 0.0, 1.0)


class ChoiceModel:
    """Makes choices out of the graph's records.

    Vertices are numbered: the events by their indices, then the goal, then the start; ``NOWHERE`` is where one is lost.

    :param graph: the skill graph
    :param model: what to expect of walks that have not been tried
    """

    def __init__(self, graph: SkillGraph, model: WalkModel) -> None:
        self.graph = graph
        self.model = model
        self._evidence: tuple[tuple[int, int], Evidence] | None = None

    def kinds(self) -> Kind:
        """Return what is known of the graph's walks beside their runs."""
        graph, edges = self.graph, self.graph.edges
        offsets = graph.centers[edges.target] - graph.centers[edges.source]
        distance = np.linalg.norm(offsets, axis=1) / graph.radius
        return Kind(distance, edges.crossing_steps, edges.forward, edges.backward)

    def choices(self, start: Start, goal: np.ndarray, runs: Runs, stance: Stance) -> Choices:
        """Return everything that can be done on the way from a start to a goal.

        :param start: where the agent stands
        :param goal: shape ``(goal_dim,)``
        :param runs: what has happened in this episode
        :param stance: what to count on
        :return: the choices in events first, those of the start last
        """
        walks = self._walks(runs, stance)
        to_goal = self._to_goal(walks, goal, runs, stance)
        everywhere = Choices.join([walks, to_goal])
        return Choices.join([everywhere, self._at_start(everywhere, start, goal, runs, stance)])

    # -- walks between events -----------------------------------------------------------------------------------------

    def evidence(self) -> Evidence:
        """Return what training has shown of each edge of the graph (worked out anew when something was learned)."""
        key = self.graph.version, self.model.version
        if self._evidence is None or self._evidence[0] != key:
            self._evidence = key, self._gather()
        return self._evidence[1]

    def _gather(self) -> Evidence:
        edges, aging, kinds = self.graph.edges, self.graph.aging(), self.kinds()
        successes, failures = edges.successes * aging, edges.failures * aging
        # A guess of the steps counts for one run.
        steps = (self.model.steps(kinds) + edges.success_steps * aging) / (1.0 + successes)
        weight = edges.landing_weight * aging[:, None]
        loss = self._loss(kinds)
        return Evidence(self.model.success(kinds), successes, failures, steps, loss, edges.landing, weight)

    def _loss(self, kinds: Kind) -> np.ndarray:
        return np.where(self.model.is_hasty(kinds), self.model.loss[0], self.model.loss[1])

    def _walks(self, runs: Runs, stance: Stance) -> Choices:
        evidence, edges = self.evidence(), self.graph.edges
        if len(runs.source):
            evidence = self._with_episode(evidence, runs)
        return self._choices(edges.source, edges.target, evidence, stance)

    def _with_episode(self, evidence: Evidence, runs: Runs) -> Evidence:
        """Count the runs of the episode as well."""
        counted = Evidence(*(column.copy() for column in evidence))
        for source, target, success, landing, count in zip(*(column.tolist() for column in runs), strict=True):
            row = self.graph.edges.find(source, target)
            if row is not None:
                _count(counted, row, success, landing, EPISODE_WEIGHT * count)
        return counted

    def _choices(self, source: np.ndarray, target: np.ndarray, evidence: Evidence, stance: Stance) -> Choices:
        """Return choices whose failures land where they did, and besides as those of their kind do."""
        loss = evidence.loss
        # One failure's worth of the kind: near where it began, or lost.
        share = np.concatenate([evidence.weight, (1.0 - loss)[:, None], loss[:, None]], axis=1)
        share /= share.sum(axis=1, keepdims=True)
        near, lost = source[:, None], np.full((len(source), 1), NOWHERE)
        landing = np.concatenate([evidence.landing, near, lost], axis=1)
        return Choices(source, target, evidence.success(stance), evidence.steps, landing, share)

    # -- the goal -----------------------------------------------------------------------------------------------------

    def _to_goal(self, walks: Choices, goal: np.ndarray, runs: Runs, stance: Stance) -> Choices:
        """Return the walks to the goal itself, from events.

        Where the goal belongs to an event, whoever can walk to that can walk to the goal as well. Otherwise, and from
        the nearest events anyway, it is a guess.
        """
        graph, vertex = self.graph, len(self.graph.events)
        distance = graph.distances(goal)
        home = graph.locate(goal)
        near = np.argsort(distance, kind="stable")[:NEAR_EVENTS]
        seen = (near == home).astype(np.float64)  # somebody was near the goal, in its event
        parts = [self._guessed(near, near, vertex, distance[near], seen, runs, stance)]
        if home != NOWHERE:
            rows = np.flatnonzero(walks.target == home)
            between = np.maximum(graph.distances(graph.centers[home])[walks.source[rows]], 1e-9)
            stretch = np.clip(distance[walks.source[rows]] / between, 0.5, 2.0)
            copies = walks.take(rows)
            # What has been tried in this episode is known better from the guesses.
            untried = ~np.isin(copies.source, runs.source[runs.target == vertex]) & ~np.isin(copies.source, near)
            copies = copies._replace(
                target=np.full(len(rows), vertex), success=BESIDE * copies.success, steps=stretch * copies.steps
            )
            parts.append(copies.take(untried))
        return Choices.join(parts)

    def _guessed(
        self,
        source: np.ndarray,
        event: np.ndarray,
        target: int | np.ndarray,
        distance: np.ndarray,
        seen: np.ndarray,
        runs: Runs,
        stance: Stance,
    ) -> Choices:
        """Return walks that no edge stands for, by their distance and what the episode has shown.

        :param source: vertices where they begin
        :param event: events that runs of them are recorded for
        :param target: where they lead
        :param distance: in goal units
        :param seen: 1 where somebody has been near the target, 0 elsewhere
        """
        n, radii = len(source), distance / self.graph.radius
        steps = seen * self.model.steps_per_radius * radii
        kind = Kind(radii, steps, seen, np.zeros(n))
        landing = np.full((n, self.graph.edges.landing.shape[1]), NOWHERE)
        none = np.zeros(n)
        evidence = Evidence(
            self.model.success(kind),
            none,
            none.copy(),
            self.model.steps(kind),
            self._loss(kind),
            landing,
            np.zeros(landing.shape),
        )
        targets = np.broadcast_to(np.asarray(target), (n,)).copy()
        for i, (begin, end) in enumerate(zip(event.tolist(), targets.tolist(), strict=True)):
            for run in np.flatnonzero((runs.source == begin) & (runs.target == end)).tolist():
                _count(evidence, i, bool(runs.success[run]), int(runs.landing[run]), EPISODE_WEIGHT * runs.count[run])
        return self._choices(source, targets, evidence, stance)

    # -- the start ----------------------------------------------------------------------------------------------------

    def _at_start(self, everywhere: Choices, start: Start, goal: np.ndarray, runs: Runs, stance: Stance) -> Choices:
        """Return what can be done at the start: what can be done in its event, and walks that always can be tried."""
        graph, n_events = self.graph, len(self.graph.events)
        vertex = n_events + 1
        here = everywhere.take(np.flatnonzero(everywhere.source == start.event)[: len(everywhere.source)])
        if start.event == NOWHERE:
            here = here.take(np.zeros(0, dtype=np.int64))
        parts = [here._replace(source=np.full(len(here.source), vertex))]
        one = np.array([vertex])
        event = np.array([start.event])
        if not (here.target == n_events).any():
            distance = np.array([np.linalg.norm(goal - start.point)])
            parts.append(self._guessed(one, event, n_events, distance, np.zeros(1), runs, stance))
        distances = graph.distances(start.point)
        if start.event == NOWHERE:
            near = np.argsort(distances, kind="stable")[:NEAR_EVENTS]
            source, events = np.full(len(near), vertex), np.full(len(near), NOWHERE)
            parts.append(self._guessed(source, events, near, distances[near], np.zeros(len(near)), runs, stance))
        elif distances[start.event] > graph.radius:
            # At the edge of its event: to walk to the middle first may help.
            parts.append(self._guessed(one, event, start.event, distances[event], np.ones(1), runs, stance))
        joined = Choices.join(parts)
        if start.event != NOWHERE:
            joined.landing[joined.landing == vertex] = start.event
        return joined


def _count(evidence: Evidence, row: int, success: bool, landing: int, weight: float) -> None:
    """Add runs to a row of the evidence, in place."""
    if success:
        evidence.successes[row] += weight
        return
    evidence.failures[row] += weight
    landings, weights = evidence.landing[row], evidence.weight[row]
    known = np.flatnonzero((landings == landing) & (weights > 0.0))
    slot = int(known[0]) if len(known) else int(weights.argmin())
    landings[slot] = landing
    weights[slot] += weight
