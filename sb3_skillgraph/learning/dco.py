"""Salient events by deep covering options: the two ends of the explored space (sections 2.3, 3.2.1, A.1)."""

from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.torch_layers import create_mlp

from sb3_skillgraph.memory.store import TransitionStore

#: Environment steps between two embeddings, each of which takes half a second to learn.
LEARN_EVERY = 5_000
#: Units of the network's hidden layers, and to which half side the explored box is scaled before the first sine: more follows
#: thinner walls.
NET_ARCH, FREQUENCY = [128, 128], 10.0
#: Of its learning: Adam's rate at the beginning, which falls to 0; gradient steps; transitions in each.
LEARNING_RATE, N_UPDATES, BATCH_SIZE = 1e-3, 1_000, 256
#: Weight of the constraints on mean and variance.
PENALTY = 1.0


class Sine(th.nn.Module):
    """The sine as an activation function."""

    def forward(self, inputs: th.Tensor) -> th.Tensor:
        """:param inputs: any shape"""
        return inputs.sin()


class FiedlerEmbedding:
    """A network that approximates the Fiedler vector of the graph that transitions span.

    The Fiedler vector is the eigenvector of the graph's Laplacian with the second smallest eigenvalue: of all functions
    with mean 0 and variance 1 the one that changes least along transitions. Wu et al. (2019,
    https://arxiv.org/abs/1810.04586) find it by gradient descent (*graph drawing*), and Jinnai et al. (2020) use it for
    deep covering options; with the constant as the first eigenvector their objective is ::

        1/2 E[(f(s) - f(s'))^2] + penalty * ((E[f^2] - 1)^2 + 2 E[f]^2)

    Across a wall the Fiedler vector jumps. The hidden units are sines, which can follow it there; ReLU and tanh networks
    find the smoother second-best vector instead.

    :param points: where the transitions begin that it is learned from, shape ``(n, goal_dim)``
    :param successors: where they end, shape ``(n, goal_dim)``
    :param rng: draws the initial weights and the minibatches
    """

    def __init__(self, points: np.ndarray, successors: np.ndarray, rng: np.random.Generator) -> None:
        self._center = points.mean(axis=0)
        self._scale = FREQUENCY / (float(np.abs(points - self._center).max()) or 1.0)
        with th.random.fork_rng(devices=[]):  # learning elsewhere must not depend on whether this was called
            th.manual_seed(int(rng.integers(2**31)))
            self._net = th.nn.Sequential(*create_mlp(points.shape[1], 1, NET_ARCH, Sine))
        optimizer = th.optim.Adam(self._net.parameters(), lr=LEARNING_RATE, fused=True)
        decay = th.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.0, N_UPDATES)
        pairs = th.stack([self._input(points), self._input(successors)])
        for rows in rng.integers(0, len(points), (N_UPDATES, BATCH_SIZE)):
            f, f_next = self._net(pairs[:, rows])
            drawn = 0.5 * (f - f_next).pow(2).mean()
            # Two halves of the batch make the squares of expectations unbiased.
            (mean_a, mean_b), (square_a, square_b) = (x.view(2, -1).mean(dim=1) for x in (f, f.pow(2)))
            loss = drawn + PENALTY * ((square_a - 1) * (square_b - 1) + 2 * mean_a * mean_b)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            decay.step()

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Evaluate the embedding.

        :param points: shape ``(n, goal_dim)``
        :return: shape ``(n,)``; its sign is arbitrary
        """
        with th.no_grad():
            return self._net(self._input(points)).numpy().ravel()

    def _input(self, points: np.ndarray) -> th.Tensor:
        return th.as_tensor((points - self._center) * self._scale, dtype=th.float32)


def learn_fiedler(store: TransitionStore, reach: int, n_pairs: int, rng: np.random.Generator) -> FiedlerEmbedding:
    """Learn the Fiedler embedding of an agent's experience.

    Pairs of states some steps apart on one trajectory, instead of neighbours, make the slowest direction stand out
    (Wu et al. 2019: multi-step transitions).

    :param store: the experience
    :param reach: environment steps that a pair lies at most apart
    :param n_pairs: number of pairs
    :param rng: random generator
    """
    rows = rng.integers(store.oldest, store.total, n_pairs)
    later = store.future(rows, reach, rng)
    return FiedlerEmbedding(store.column("achieved_goal", rows), store.column("next_achieved_goal", later), rng)


class DCOSalience:
    """The two visited states that are farthest apart in the graph of the agent's transitions (section 3.2.1, *DCO*).

    From time to time a :class:`FiedlerEmbedding` is learned from scratch; where it is largest and where it is
    smallest are proposed in turn.

    :param store: the agent's transitions
    :param reach: environment steps that a pair lies at most apart
    :param relearn: transitions after which another embedding is learned
    :param n_pairs: pairs that an embedding is learned from
    """

    def __init__(self, store: TransitionStore, reach: int, relearn: int = LEARN_EVERY, n_pairs: int = 20_000) -> None:
        self.store = store
        self.reach = reach
        self.relearn = relearn
        self.n_pairs = n_pairs
        self._ends: list[np.ndarray] = []
        self._turn = 0
        self._learned_from = 0  # transitions

    def propose(self, rng: np.random.Generator) -> np.ndarray | None:
        """Propose one end of the explored space, then the other; None before there is any experience."""
        if not len(self.store):
            return None
        since = self.store.total - self._learned_from  # negative where the replay buffer was not loaded
        if not self._ends or not 0 <= since < self.relearn:
            self._learned_from = self.store.total
            embedding = learn_fiedler(self.store, self.reach, self.n_pairs, rng)
            rows = rng.integers(self.store.oldest, self.store.total, self.n_pairs)
            points = self.store.column("achieved_goal", rows).astype(np.float64)
            values = embedding(points)
            self._ends = [points[i].copy() for i in (values.argmin(), values.argmax())]
        self._turn = 1 - self._turn
        return self._ends[self._turn]

    def get_state(self) -> dict[str, Any]:
        """Return what was learned last as plain data."""
        return {"ends": self._ends, "turn": self._turn, "learned_from": self._learned_from}

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`get_state` returned."""
        self._ends, self._turn, self._learned_from = list(state["ends"]), state["turn"], state["learned_from"]
