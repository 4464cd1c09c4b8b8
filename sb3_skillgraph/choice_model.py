"""What an agent could do in each event, and what would come of it: the model that plans are made on."""

from typing import Any

import numpy as np

from sb3_skillgraph.choices import GUESS_RUNS, Choices, Runs, Start
from sb3_skillgraph.edges import MAX_LANDINGS, NOWHERE, land
from sb3_skillgraph.graph import SkillGraph
from sb3_skillgraph.walk_model import Kind, WalkModel, timeout

#: Runs that one run of the running episode counts for: it began nearest in time and place, and without noise.
EPISODE_WEIGHT = 3.0
#: Events nearest to a goal, or to a start, from which it is considered to walk there though nobody was seen to.
NEAR_EVENTS = 6
#: What a run tells of others that begin or end in the same event, in runs of their own; and of all of them, at most.
KINSHIP, MOST_KINSHIP = 0.25, 2.0
#: A failed run has landed far away where that is so many times further than it was to go.
FAR = 2.0
#: Share of the success of a walk to an event that is left for a goal beside its centre.
BESIDE = 0.98

#: Weights of runs by the events that walks begin in, and by those that they lead to: of some of the runs, and of all. Of
#: hasty walks, which are no kin of others, they stand behind those of all others.
ByEnd = list[tuple[np.ndarray, np.ndarray]]


class ChoiceModel:
    """Makes choices out of the graph's records.

    :param graph: the skill graph
    :param model: what to expect of walks that have not been tried
    """

    def __init__(self, graph: SkillGraph, model: WalkModel) -> None:
        self.graph = graph
        self.model = model
        self._known: tuple[tuple[Any, int], Choices, ByEnd] | None = None

    @property
    def version(self) -> tuple[Any, int]:
        """Changes whenever something is learned."""
        return self.graph.version, self.model.version

    # -- walks between events -----------------------------------------------------------------------------------------

    def walks(self) -> Choices:
        """Return what training has shown of each edge, in the order of the graph's edges (not to be changed)."""
        return self._shown()[0]

    def _shown(self) -> tuple[Choices, ByEnd]:
        """Return the walks, and the successes and runs of their kin; the same until something is learned."""
        if self._known is None or self._known[0] != self.version:
            self._known = self.version, *self._gather()
        return self._known[1:]

    def kinds(self) -> Kind:
        """Return what is known of the graph's walks beside their runs."""
        graph, edges = self.graph, self.graph.edges
        ends = graph.centers[edges.target], graph.centers[edges.source]
        distance, changes = graph.metric.travel(*ends), graph.metric.mismatches(*ends)
        return Kind(distance, edges.crossing_steps, edges.forward, edges.backward, changes)

    def _gather(self) -> tuple[Choices, ByEnd]:
        edges, aging, kinds = self.graph.edges, self.graph.aging(), self.kinds()
        # What has been tried tells by its own runs, what has not by what others of its kind and place have done
        successes, failures = edges.successes * aging, edges.failures * aging
        apart = len(self.graph.events) * self.model.is_hasty(kinds)  # hasty walks have events of their own, behind the others
        ends = edges.source + apart, edges.target + apart
        kin = self._by_end(ends, successes, successes + failures)
        guess = self._with_kin(self.model.success(kinds), ends, kin, successes, successes + failures)
        # A guess of the steps counts for one run.
        steps = (self.model.steps(kinds) + edges.success_steps * aging) / (1.0 + successes)
        failed_steps = (self.model.patience * timeout(steps) + edges.failure_steps * aging) / (1.0 + failures)
        failed_steps = np.minimum(failed_steps, timeout(steps))  # it may have been allowed more when it was slower
        far = self.far_failures(kinds)
        loss = self._with_kin(self._loss(kinds), ends, self._by_end(ends, far, failures), far, failures)
        weight = edges.landing_weight * aging[:, None]
        known = (edges.source, edges.target, guess, successes, failures)
        return Choices(*known, steps, failed_steps, loss, edges.landing, weight), kin

    def _loss(self, kinds: Kind) -> np.ndarray:
        return np.where(self.model.is_hasty(kinds), self.model.loss[0], self.model.loss[1])

    def _by_end(self, ends: tuple[np.ndarray, np.ndarray], hits: np.ndarray, runs: np.ndarray) -> ByEnd:
        """Return the weights of the runs of edges, summed by the events at their ends.

        :param ends: where each begins, and where it leads, shapes ``(n_edges,)``
        :param hits: weight of some of the runs of each edge
        :param runs: weight of all of its runs
        """
        n = 2 * len(self.graph.events)
        return [(np.bincount(events, hits, n), np.bincount(events, runs, n)) for events in ends]

    @staticmethod
    def _with_kin(
        guess: np.ndarray,
        ends: tuple[np.ndarray, np.ndarray],
        by_end: ByEnd,
        hits: np.ndarray | float = 0.0,
        runs: np.ndarray | float = 0.0,
    ) -> np.ndarray:
        """Return guessed shares, corrected by the runs of kin: of edges out of the same event, and into the same one.

        :param guess: shape ``(n,)``
        :param ends: where each walk begins, and where it leads, shapes ``(n,)``
        :param by_end: the runs of all edges
        :param hits: weight of the runs of each walk of which the share is guessed
        :param runs: weight of all of its runs
        """
        # The guess counts for as many runs as it does everywhere, kin for a share of theirs, no run for itself
        total, weight = GUESS_RUNS * guess, np.full(len(guess), GUESS_RUNS)
        for events, (all_hits, all_runs) in zip(ends, by_end, strict=True):
            kin_hits, kin_runs = all_hits[events] - hits, all_runs[events] - runs
            scale = np.minimum(KINSHIP, MOST_KINSHIP / np.maximum(kin_runs, 1e-9))
            total += scale * kin_hits
            weight += scale * kin_runs
        return np.clip(total / weight, 0.0, 1.0)

    def far_failures(self, kinds: Kind) -> np.ndarray:
        """Return the weight of the failed runs of each edge that landed far away or nowhere, shape ``(n_edges,)``.

        :param kinds: of the edges
        """
        graph, edges = self.graph, self.graph.edges
        rows = np.flatnonzero(edges.failures > 0.0)
        result = np.zeros(edges.size)
        landing = edges.landing[rows]
        away = graph.metric.travel(graph.centers[landing], graph.centers[edges.source[rows]][:, None])
        far = (landing == NOWHERE) | (away > FAR * (kinds.distance[rows, None] + 1.0))
        result[rows] = (edges.landing_weight[rows] * far).sum(axis=1) * graph.aging()[rows]
        return result

    # -- what an episode adds -----------------------------------------------------------------------------------------

    def of_episode(self, start: Start, goal: np.ndarray, runs: Runs, everywhere: bool = False) -> tuple[np.ndarray, Choices]:
        """Return what can be done beside what training has shown.

        :param start: where the agent stands
        :param goal: shape ``(goal_dim,)``
        :param runs: what has happened in this episode
        :param everywhere: whether walks straight to the goal are considered from all events, however far away
        :return: edges that the episode has shown more of, and the choices that take their place or come on top: those, the
            walks to the goal, and last what can be done at the start
        """
        replaced, tried = self._tried(runs)
        to_goal = self._to_goal(replaced, tried, goal, runs, everywhere)
        return replaced, Choices.join([tried, to_goal, self._at_start(replaced, tried, to_goal, start, goal, runs)])

    def _tried(self, runs: Runs) -> tuple[np.ndarray, Choices]:
        """Return the edges that the episode has runs of, and what is known of them with those."""
        found = (self.graph.edges.find(u, v) for u, v in zip(runs.source.tolist(), runs.target.tolist(), strict=True))
        replaced = np.unique(np.array([row for row in found if row is not None], dtype=np.int64))
        tried = self.walks().take(replaced)
        self._add_episode(tried, tried.source, runs)
        return replaced, tried

    @staticmethod
    def _add_episode(choices: Choices, events: np.ndarray, runs: Runs) -> None:
        """Add the episode's runs to choices, in place; they are recorded for the events that these begin in."""
        for event, target, success, landing, number in zip(*(column.tolist() for column in runs), strict=True):
            weight = EPISODE_WEIGHT * number
            for row in np.flatnonzero((events == event) & (choices.target == target)).tolist():
                if success:
                    choices.successes[row] += weight
                else:
                    choices.failures[row] += weight
                    land(choices.landing[row], choices.weight[row], landing, weight)

    def _edges(self, chosen: np.ndarray, replaced: np.ndarray, tried: Choices) -> Choices:
        """Return some of the graph's edges, with what the episode has shown of them."""
        rows = np.flatnonzero(chosen)
        return Choices.join([self.walks().take(rows[~np.isin(rows, replaced)]), tried.take(chosen[replaced])])

    def _to_goal(self, replaced: np.ndarray, tried: Choices, goal: np.ndarray, runs: Runs, everywhere: bool) -> Choices:
        """Return the walks to the goal itself, from events.

        Where the goal belongs to an event, whoever can walk to that can walk to the goal as well. From there itself, and from
        the events nearest to the goal if they have no such walk, it is a guess; a walk that would be longer than any in the
        graph is considered only where there is no shorter one.
        """
        graph, known = self.graph, []
        home = graph.locate(goal)
        near = np.argsort(graph.distances(goal), kind="stable")
        if not everywhere:
            near = near[:NEAR_EVENTS]
        if home != NOWHERE:
            known = [self._beside(self._edges(graph.edges.target == home, replaced, tried), home, goal, runs)]
            near = near[~np.isin(near, known[0].source)]
        guessed = self._straight_on(near, near, graph.centers[near], goal, home, runs)
        if not everywhere:
            guessed = self._short(guessed, least=0 if any(len(walks.source) for walks in known) else 1)
        return Choices.join([guessed, *known])

    def _straight_on(
        self, source: np.ndarray, event: np.ndarray, begin: np.ndarray, goal: np.ndarray, home: int, runs: Runs
    ) -> Choices:
        """Return walks straight to a goal that no edge stands for.

        :param source: vertices where they begin, shape ``(n,)``
        :param event: events that these belong to, ``NOWHERE`` if to none
        :param begin: where that is, shape ``(n, goal_dim)``
        :param goal: shape ``(goal_dim,)``
        :param home: the goal's event, ``NOWHERE`` if it lies in none
        :param runs: of the episode
        """
        # Who was in the goal's event was near the goal; and that there is no edge tells nothing where it was let go
        at_home = (event == home) & (event != NOWHERE)
        let_go = np.array([(each, home) in self.graph.edges.let_go for each in event.tolist()], dtype=bool)
        seen = (at_home | let_go).astype(np.float64)
        guessed = self._guessed(source, event, len(self.graph.events), begin, goal, seen, runs)
        if not let_go.any():
            return guessed
        # Such walks are judged by their kin, as those are that an edge stands for
        _, kin = self._shown()
        judged = self._with_kin(guessed.guess, (event, np.full_like(event, home)), kin)
        return guessed._replace(guess=np.where(let_go, judged, guessed.guess))

    def _short(self, guessed: Choices, least: int) -> Choices:
        """Return the guessed walks that are no longer than those of the graph.

        :param guessed: walks to the goal
        :param least: how many to keep, however long they are: the shortest
        """
        rank = np.argsort(np.argsort(guessed.steps, kind="stable"), kind="stable")
        return guessed.take(np.flatnonzero((guessed.steps <= self.graph.walk_steps) | (rank < least)))

    def _beside(self, walks: Choices, home: int, goal: np.ndarray, runs: Runs) -> Choices:
        """Return walks to the goal for the walks to its event.

        :param walks: to the event
        :param home: index of the event
        :param goal: shape ``(goal_dim,)``
        :param runs: of the episode
        """
        vertex, centers, metric = len(self.graph.events), self.graph.centers, self.graph.metric
        between = np.maximum(metric.travel(centers[walks.source], centers[home]), 1e-9)
        stretch = np.clip(metric.travel(centers[walks.source], goal) / between, 0.5, 2.0)
        beside = walks._replace(
            target=np.full(len(walks.target), vertex),
            guess=BESIDE * walks.guess,
            successes=BESIDE * walks.successes,
            steps=stretch * walks.steps,
            failed_steps=stretch * walks.failed_steps,
        )
        self._add_episode(beside, beside.source, runs)
        return beside

    def _guessed(
        self,
        source: np.ndarray,
        event: np.ndarray,
        target: int | np.ndarray,
        begin: np.ndarray,
        end: np.ndarray,
        seen: np.ndarray,
        runs: Runs,
    ) -> Choices:
        """Return walks that no edge stands for, by where they begin and lead and what the episode has shown.

        :param source: vertices where they begin, shape ``(n,)``
        :param event: events that runs of them are recorded for
        :param target: vertices where they lead
        :param begin: where that is, shape ``(n, goal_dim)`` or ``(goal_dim,)``
        :param end: where they lead, likewise
        :param seen: 1 where somebody has been near the target, 0 elsewhere
        :param runs: of the episode
        """
        n, metric = len(source), self.graph.metric
        distance, changes = metric.travel(begin, end), metric.mismatches(begin, end)
        kind = Kind(distance, seen * self.model.steps_per_radius * distance, seen, np.zeros(n), changes)
        steps = self.model.steps(kind)
        runs_known = np.zeros(n), np.zeros(n), steps, self.model.patience * timeout(steps)
        landings = np.full((n, MAX_LANDINGS), NOWHERE), np.zeros((n, MAX_LANDINGS))
        guessed = Choices(source, np.full(n, target), self.model.success(kind), *runs_known, self._loss(kind), *landings)
        self._add_episode(guessed, event, runs)
        return guessed

    def _at_start(
        self, replaced: np.ndarray, tried: Choices, to_goal: Choices, start: Start, goal: np.ndarray, runs: Runs
    ) -> Choices:
        """Return what can be done at the start: what can be done in its event, and walks that can be tried."""
        graph, n_events = self.graph, len(self.graph.events)
        here = np.array([n_events + 1])
        event = np.array([start.event])
        parts = []
        if start.event != NOWHERE:
            parts += [self._edges(graph.edges.source == start.event, replaced, tried)]
            parts += [to_goal.take(to_goal.source == start.event)]
            if not graph.metric.reached(start.point, graph.centers[start.event]):
                # At the edge of its event: to walk to the middle first may help.
                parts.append(self._guessed(here, event, start.event, start.point, graph.centers[event], np.ones(1), runs))
        else:
            near = np.argsort(graph.distances(start.point), kind="stable")[:NEAR_EVENTS]
            nowhere = np.full(len(near), NOWHERE)
            parts.append(self._guessed(near, nowhere, near, start.point, graph.centers[near], np.zeros(len(near)), runs))
        # There always is a way: at worst the walk straight to the goal
        targets = np.concatenate([part.target for part in parts])
        if n_events not in targets:
            direct = self._straight_on(here, event, start.point[None], goal, graph.locate(goal), runs)
            # One that would be longer than any walk in the graph is begun only where there is nothing else to do.
            if direct.steps[0] <= graph.walk_steps or not len(targets) or start.towards == n_events:
                parts.append(direct)
        # What runs already is a choice, too, even where nothing else would lead there
        if start.towards not in (NOWHERE, n_events) and start.towards not in targets:
            end = graph.centers[[start.towards]]
            parts.append(self._guessed(here, event, start.towards, start.point, end, np.ones(1), runs))
        choices = Choices.join(parts)
        return choices._replace(source=np.full(len(choices.source), n_events + 1))
