"""Options that no plan uses any more are let go: their networks are most of what an agent weighs."""

from collections.abc import Collection
from typing import Any

import numpy as np

from sb3_skillgraph.chaining import DeepSkillChaining, SkillChain
from sb3_skillgraph.visited import VisitedStates

EVERY = 10  # episodes between two looks
N_STARTS = 100  # visited states from which plans are looked at


class Pruning:
    """Looks now and then which options plans use, and lets chains go that have not been used for long.

    A plan is the cheapest path to an event, from a visited state. A chain that something is still to be learned about
    stays, whether plans use it or not.

    :param chaining: the chains and their options
    :param visited: the agent's trajectories
    :param after: episodes without use after which a chain is let go; None never does
    """

    def __init__(self, chaining: DeepSkillChaining, visited: VisitedStates, after: int | None) -> None:
        self.chaining = chaining
        self.graph = chaining.graph
        self.visited = visited
        self.after = after
        self.next_look = EVERY
        self.last_used: dict[str, int] = {}

    def due(self, n_episodes: int) -> bool:
        """Tell whether it is time to look.

        :param n_episodes: episodes completed so far
        """
        return self.after is not None and n_episodes >= self.next_look

    def prune(self, n_episodes: int, running: Collection[str]) -> list[SkillChain]:
        """Look which options plans use, and let go of chains that have not been used for long.

        :param n_episodes: episodes completed so far
        :param running: ids of options that are running, and of chains that are being practised
        :return: the chains that have lost their options
        """
        assert self.after is not None
        self.next_look = n_episodes + EVERY
        used = self.used()
        for id in self.chaining.options:
            if id in used or id not in self.last_used:
                self.last_used[id] = n_episodes
        pruned = [
            chain
            for chain in self.chaining.chains.values()
            if chain.options
            and not chain.open
            and chain.id not in running
            and all(n_episodes - self.last_used[id] >= self.after and id not in running for id in chain.options)
        ]
        for id in self.chaining.remove(pruned):
            del self.last_used[id]
        return pruned

    def used(self) -> set[str]:
        """Return the ids of the options on the cheapest paths from visited states to events."""
        used: set[str] = set()
        if self.visited.size == 0:
            return used
        for i in np.linspace(0, self.visited.size - 1, N_STARTS).astype(int):
            used |= self.graph.ways_from(self.graph.useful(self.visited.points[i])).on_the_way(self.graph.events)
        return used & self.graph.options.keys()

    def get_state(self) -> dict[str, Any]:
        """Return when options were last used as plain data."""
        return {"next_look": self.next_look, "last_used": self.last_used}

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`get_state` returned."""
        self.next_look, self.last_used = state["next_look"], dict(state["last_used"])
