"""What the agent is about while it learns, by the paper: events found, targets picked (sections 3.2.1, 3.2.2, A.1, A.3)."""

import math
from typing import Any

import numpy as np

from sb3_skillgraph.edges import NOWHERE
from sb3_skillgraph.events import Event
from sb3_skillgraph.learning.missions import Agenda, Mission
from sb3_skillgraph.learning.salience import Salience
from sb3_skillgraph.paper.chaining import DeepSkillChaining
from sb3_skillgraph.paper.graph import PaperGraph
from sb3_skillgraph.rules import PaperRules
from sb3_skillgraph.running import Run

_COUNTERS = ("n_episodes", "last_accepted", "last_rejected", "newest")


class PaperMissions(Agenda):
    """Finds salient events, and picks one of all of them as the target, each as likely.

    :param graph: the skill graph
    :param chaining: the chains
    :param salience: proposes salient events
    :param rules: the paper's numbers
    :param exploration_steps: environment steps of a random walk, where there is no event to go to
    :param rng: random generator
    """

    def __init__(
        self,
        graph: PaperGraph,
        chaining: DeepSkillChaining,
        salience: Salience,
        rules: PaperRules,
        exploration_steps: int,
        rng: np.random.Generator,
    ) -> None:
        super().__init__(graph, salience, exploration_steps, rng)
        self.graph: PaperGraph = graph
        self.chaining = chaining
        self.rules = rules
        self.n_episodes = 0
        self.last_accepted = 0  # episode
        self.last_rejected: int | None = None  # episode, if nothing was accepted at the last attempt
        self.newest = ""  # id of the event accepted last

    def observe(self, env: int, point: np.ndarray, run: Run | None, done: bool) -> bool:
        """Learn that a step was taken; a target that is reached is followed by another (section 3.2.2)."""
        mission = self.current[env]
        assert mission is not None
        mission.explore_steps -= mission.exploring
        over = done or (mission.explore_steps <= 0 if mission.exploring else self.graph.metric.reached(point, mission.goal))
        self.n_episodes += done
        if over:
            self.current[env] = None
            self.prepare()
        return over

    def prepare(self) -> None:
        """Do what there is to do between missions: look for new events, where it is time to, and open the chains due."""
        if self.pinned is not None:
            self._pin(self.pinned)
            return
        if self._is_due():
            self._attempt()
        for chain in [chain for chain in self.chaining.chains if chain.complete]:
            # The way there is known: the way back is learned (A.3).
            self.chaining.open_chain(self._event(chain.target), self._event(chain.source), back=True)

    # -- choosing -----------------------------------------------------------------------------------------------------

    def _choose(self, point: np.ndarray) -> Mission:
        """Pick a target (section 3.2.2); the start is one as soon as a chain leads back there."""
        events = [event for event in self.graph.events if not event.holds(point) and self.chaining.leading_to(event.id)]
        if self.pinned is not None:
            events = [event for event in events if np.array_equal(event.center, self.pinned)]
        if not events:
            return self._random_walk(point)
        return Mission(events[self.rng.integers(len(events))].center.copy())

    def _event(self, id: str) -> Event:
        return self.graph.events[self.graph.index(id)]

    def _pin(self, goal: np.ndarray) -> None:
        """Make the goal of few-shot adaptation an event, if it is none, with a chain to it (section 3.3, cases b and c).

        In case b its root starts where another option can.
        """
        if any(np.array_equal(event.center, goal) for event in self.graph.events):
            return
        around = self.graph.holding(goal)
        event = self._add(goal)
        if around:
            self.chaining.begin_inside(self.chaining.leading_to(event.id)[0], around[0])

    # -- salient events -----------------------------------------------------------------------------------------------

    def _is_due(self) -> bool:
        """Tell whether it is time to look for salient events: one of the three conditions of A.1.2 holds."""
        if self.last_rejected is not None:
            return self.n_episodes - self.last_rejected >= self.rules.retry_after
        joined = not self.newest or self.newest in self.graph.joined()
        return joined or self.n_episodes - self.last_accepted >= self.rules.salient_event_freq

    def _attempt(self) -> None:
        """Look for a pair of salient events; each may be rejected."""
        proposals = [self.salience.propose(self.rng) for _ in range(2)]
        accepted = [self._add(point).id for point in proposals if point is not None and not self.is_redundant(point)]
        if accepted:
            self.last_accepted, self.last_rejected, self.newest = self.n_episodes, None, accepted[-1]
        else:
            self.last_rejected = self.n_episodes

    def is_redundant(self, point: np.ndarray) -> bool:
        """Tell whether an event there would teach nothing new: it lies in an event, or where an option can start (A.1.1).

        :param point: shape ``(goal_dim,)``
        """
        return self.graph.locate(point) != NOWHERE or bool(self.graph.holding(point))

    def _add(self, center: np.ndarray) -> Event:
        """Add an event, and open the chain to it from the event of the graph that is nearest to it (3.2.3, 3.2.5)."""
        joined = self.graph.joined()
        known = [event for event in self.graph.events if event.id in joined]
        event = self.graph.events[self.graph.add_event(center)]
        if known:
            source = min(known, key=lambda other: math.dist(other.center, event.center))
            self.chaining.open_chain(source, event)
        return event

    # -- saving -------------------------------------------------------------------------------------------------------

    def get_state(self) -> dict[str, Any]:
        """Return missions and counters as plain data."""
        return {**super().get_state(), **{name: getattr(self, name) for name in _COUNTERS}}

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`get_state` returned."""
        super().set_state(state)
        for name in _COUNTERS:
            setattr(self, name, state[name])
