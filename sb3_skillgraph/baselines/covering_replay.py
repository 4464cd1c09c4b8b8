"""What a deep covering option leads to, where it starts, and what it learns from (section 2.3)."""

import numpy as np

from sb3_skillgraph.learning.dco import FiedlerEmbedding
from sb3_skillgraph.memory.replay import Minibatch, OptionReplay
from sb3_skillgraph.options.initiation import InitiationSet

TERMINATION_SHARE = 0.05  # of the states seen, those with the lowest values are where an option ends


class LowEnd:
    """The states where an embedding is lower than a threshold: where a covering option ends (Jinnai et al. 2020).

    :param embedding: the approximate Fiedler vector
    :param sign: -1 for the other end
    :param points: states seen, shape ``(n, goal_dim)``
    """

    def __init__(self, embedding: FiedlerEmbedding, sign: float, points: np.ndarray) -> None:
        self.embedding = embedding
        self.sign = sign
        values = self.values(points)
        self.threshold = float(np.quantile(values, TERMINATION_SHARE))
        self.center = points[int(values.argmin())].astype(np.float64)

    def values(self, points: np.ndarray) -> np.ndarray:
        """Return the embedding, lowest at the end the option leads to.

        :param points: shape ``(n, goal_dim)``
        :return: shape ``(n,)``
        """
        return self.sign * self.embedding(points)

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Tell which points lie in the set.

        :param points: shape ``(n, goal_dim)``
        :return: bool array of shape ``(n,)``
        """
        return self.values(points) <= self.threshold

    def holds(self, point: np.ndarray) -> bool:
        """Tell whether a point, shape ``(goal_dim,)``, lies in the set."""
        return bool(self.contains(np.asarray(point)[None])[0])


class Everywhere(InitiationSet):
    """Covering options can start anywhere but where they end."""

    def optimistic(self, points: np.ndarray) -> np.ndarray:
        """:param points: shape ``(n, goal_dim)``"""
        return np.ones(len(points), dtype=bool)


class CoveringReplay(OptionReplay):
    """All experience, paid -1 a step, and for going down the embedding as far as a good step goes another 1."""

    end: LowEnd
    scale: float

    def minibatch(self, batch_size: int) -> Minibatch:
        """Draw relabelled transitions.

        :param batch_size: number of transitions
        """
        rows = self.rng.integers(self.store.oldest, self.store.total, batch_size)
        data = self.store.read(rows)
        here, there = data["achieved_goal"], data["next_achieved_goal"]
        goal = np.tile(self.end.center.astype(np.float32), (batch_size, 1))
        before, after = self.end.values(here), self.end.values(there)
        there_already, stuck = np.zeros(batch_size, dtype=bool), self.store.stuck(rows)
        # Where the task's own goal ended an episode an option would have gone on.
        done = (after <= self.end.threshold) | stuck | self.store.terminated(rows)
        pay = self.rule.reward(there_already, done, stuck, here, there, goal) + (before - after) / self.scale
        return Minibatch(
            observations=self.view(data["observation"], here, goal),
            actions=data["action"],
            next_observations=self.view(data["next_observation"], there, goal),
            dones=done.astype(np.float32)[:, None],
            rewards=pay.astype(np.float32)[:, None],
        )
