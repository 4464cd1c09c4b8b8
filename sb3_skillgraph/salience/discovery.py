"""When to look for salient events, and which to turn down (sections 3.2.1, A.1.1, A.1.2)."""

from typing import Any

import numpy as np

from sb3_skillgraph.events import SalientEvent
from sb3_skillgraph.graph import SkillGraph
from sb3_skillgraph.salience.proposals import Salience


class EventDiscovery:
    """Adds salient events to the graph.

    An attempt is due when the event accepted last has been joined to the graph, when K episodes have passed since an
    event was accepted, or when R episodes have passed since an attempt of which every proposal was rejected (A.1.2).
    A proposal is rejected if it lies (a) in an existing event or (b) in the initiation set of an option of the graph
    (A.1.1).

    :param graph: the skill graph
    :param salience: proposes events
    :param radius: the event radius, in goal units
    :param salient_event_freq: K
    :param retry_after: R
    :param events_per_attempt: how many events an attempt proposes (the paper: a pair)
    :param n_tries: proposals drawn for each of them until one is accepted
    :param max_unconnected: no attempt is made while the chains that join so many events are open; None for no limit
    """

    def __init__(
        self,
        graph: SkillGraph,
        salience: Salience,
        radius: float,
        salient_event_freq: int,
        retry_after: int,
        events_per_attempt: int,
        n_tries: int,
        max_unconnected: int | None,
    ) -> None:
        self.graph = graph
        self.salience = salience
        self.radius = radius
        self.salient_event_freq = salient_event_freq
        self.retry_after = retry_after
        self.events_per_attempt = events_per_attempt
        self.n_tries = n_tries
        self.max_unconnected = max_unconnected
        self.n_rejected = 0
        self.last_accepted = 0  # episode
        self.last_rejected: int | None = None  # episode of an attempt of which nothing was accepted, if it was the last
        self.newest: str | None = None

    def due(self, episode: int, connected: set[str]) -> bool:
        """Tell whether an attempt is due.

        :param episode: number of completed episodes
        :param connected: ids of the events whose joining chain is complete or given up
        """
        n_unconnected = len(self.graph.events) - len(connected)
        if self.max_unconnected is not None and n_unconnected >= self.max_unconnected:
            return False
        if self.last_rejected is not None:
            return episode - self.last_rejected >= self.retry_after
        joined = self.newest is None or self.newest in connected
        return joined or episode - self.last_accepted >= self.salient_event_freq

    def attempt(self, episode: int, rng: np.random.Generator) -> list[SalientEvent]:
        """Propose events and add those that are not redundant to the graph.

        :param episode: number of completed episodes
        :param rng: random generator
        :return: the events added
        """
        accepted = [event for _ in range(self.events_per_attempt) if (event := self._one(rng)) is not None]
        if accepted:
            self.last_accepted, self.last_rejected, self.newest = episode, None, accepted[-1].id
        else:
            self.last_rejected = episode
        return accepted

    def _one(self, rng: np.random.Generator) -> SalientEvent | None:
        for _ in range(self.n_tries):
            center = self.salience.propose(rng)
            if center is None:
                return None
            if not self.redundant(center):
                return self.add(center)
            self.n_rejected += 1
        return None

    def redundant(self, center: np.ndarray) -> bool:
        """Tell whether an event there would teach nothing new (A.1.1).

        :param center: shape ``(goal_dim,)``
        """
        point = np.asarray(center)
        return bool(self.graph.event_bank.holding(point) or self.graph.startable(point))

    def add(self, center: np.ndarray) -> SalientEvent:
        """Add an event to the graph whatever is there.

        :param center: shape ``(goal_dim,)``
        """
        event = SalientEvent(f"e{len(self.graph.events)}", center, self.radius)
        self.graph.add_event(event)
        return event

    def get_state(self) -> dict[str, Any]:
        """Return the counters as plain data."""
        names = ("n_rejected", "last_accepted", "last_rejected", "newest")
        return {name: getattr(self, name) for name in names}

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`get_state` returned."""
        vars(self).update(state)
