"""What an option learns from: rows of the shared store, relabelled by its rule."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

from sb3_skillgraph.events import TerminationSet
from sb3_skillgraph.memory.store import TransitionStore
from sb3_skillgraph.metric import Metric


class Minibatch(NamedTuple):
    """SB3's ``ReplayBufferSamples`` as arrays of shape ``(batch, width)``: the compiled update needs no tensors."""

    observations: np.ndarray
    actions: np.ndarray
    next_observations: np.ndarray
    dones: np.ndarray
    rewards: np.ndarray
    discounts: np.ndarray | None = None


class OptionRule(NamedTuple):
    """What an option is paid for and where it ends (section 2.1): -1 a step, and 0 on reaching its goal, which ends it.

    Where the agent gets stuck it pays what standing there forever would.

    :param metric: of goal space
    :param tolerance: how near a goal counts as reached, in radii
    :param gamma: discount factor
    :param shaping: further reward for a radius of distance gained; it is the change of a potential (Ng et al., 1999),
        which changes no policy's rank
    :param termination: the set it ends in; None for an option that is given its goal, and ends near it
    """

    metric: Metric
    tolerance: float = 1.0
    gamma: float = 0.99
    shaping: float = 0.0
    termination: TerminationSet | None = None

    def reached(self, achieved_goal: np.ndarray, goal: np.ndarray, imagined: np.ndarray) -> np.ndarray:
        """Tell which transitions reach the goal, bool array of shape ``(n,)``.

        :param achieved_goal: where they end, shape ``(n, goal_dim)``
        :param goal: same shape
        :param imagined: whether the goal was put in by hindsight: then to reach it is to come near it in any case
        """
        hit = self.metric.distance(achieved_goal, goal) <= self.tolerance * self.metric.radius
        if self.termination is not None:
            hit[~imagined] = self.termination.contains(achieved_goal[~imagined])
        return hit

    def reward(
        self,
        reached: np.ndarray,
        over: np.ndarray,
        stuck: np.ndarray,
        before: np.ndarray,
        after: np.ndarray,
        goal: np.ndarray,
    ) -> np.ndarray:
        """Return the reward for transitions, shape ``(n,)``.

        :param reached: which reached the goal, shape ``(n,)``
        :param over: after which there was no going on, for this or another reason, shape ``(n,)``
        :param stuck: in which the agent got stuck, shape ``(n,)``
        :param before: where the agent stood, shape ``(n, goal_dim)``
        :param after: where it came to stand, same shape
        :param goal: same shape
        """
        reward = np.where(stuck, -1.0 / max(1.0 - self.gamma, 1e-3), np.where(reached, 0.0, -1.0))
        if self.shaping:
            potential = self.gamma * self.metric.travel(after, goal) * ~over
            reward += self.shaping * (self.metric.travel(before, goal) - potential)
        return reward.astype(np.float32)


class OptionReplay(ReplayBuffer):
    """What one option learns from: rows of the shared store, seen with the option's goal, reward and end.

    It holds row numbers only. Each sampled transition keeps the goal that was pursued, or, with probability
    ``hindsight``, takes a goal that its trajectory achieved later (Andrychowicz et al., 2017), unless the agent got stuck
    soon after; reward and end are recomputed by the option's rule. A share of every batch may come from the whole store,
    in hindsight as often as possible, so that an option that copied the global one does not unlearn what it copied.

    :param store: the shared memory
    :param view: what a policy sees: ``(observation, achieved_goal, goal) -> (n, dim)``
    :param rule: the option's pay and end
    :param observation_space: flat space of what the policy sees
    :param action_space: action space of the environment
    :param rng: random generator for sampling
    :param hindsight: share of own transitions that take an achieved goal
    :param shared: share of a batch that comes from the whole store
    :param horizon: steps ahead from which an achieved goal is drawn
    :param aim: returns the point that its policy is to aim at, shape ``(goal_dim,)``; None for the goal that was pursued
    :param doomed_steps: steps before the agent got stuck in which no goal is put in
    :param device: torch device of the samples
    """

    def __init__(
        self,
        store: TransitionStore,
        view: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray],
        rule: OptionRule,
        observation_space: spaces.Box,
        action_space: spaces.Box,
        rng: np.random.Generator,
        *,
        hindsight: float = 0.8,
        shared: float = 0.5,
        horizon: int = 200,
        aim: Callable[[], np.ndarray] | None = None,
        doomed_steps: int = 50,
        device: th.device | str = "auto",
    ) -> None:
        # SB3's constructor allocates buffer_size rows of its own; the shared store holds ours.
        super().__init__(1, observation_space, action_space, device=device, handle_timeout_termination=False)
        self.store = store
        self.view = view
        self.rule = rule
        self.rng = rng
        self.hindsight = hindsight
        self.shared = shared
        self.horizon = horizon
        self.aim = aim
        self.doomed_steps = doomed_steps
        self._rows = np.zeros(256, dtype=np.int64)
        self._n_rows = 0

    def size(self) -> int:
        """Return how many transitions of its own the option can learn from."""
        return len(self.store) if self.rule.termination is None else len(self._readable())

    def add_rows(self, rows: np.ndarray) -> None:
        """Remember rows on which the option ran.

        :param rows: row numbers of the store, ascending
        """
        n_rows = self._n_rows + len(rows)
        if n_rows > len(self._rows):
            # Full: rows that the store has overwritten make room, and as much again as is kept
            kept = self._readable()
            n_rows = len(kept) + len(rows)
            self._rows = np.concatenate([kept, np.zeros(n_rows + len(rows), dtype=np.int64)])
        self._rows[n_rows - len(rows) : n_rows] = rows
        self._n_rows = n_rows

    def _readable(self) -> np.ndarray:
        rows = self._rows[: self._n_rows]
        return rows[np.searchsorted(rows, self.store.oldest) :]

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> ReplayBufferSamples:
        """Draw relabelled transitions.

        :param batch_size: number of transitions
        :param env: not used; sets live in raw goal space, so observations are not normalised
        :return: tensors of shape ``(batch_size, ...)``
        """
        *columns, _ = self.minibatch(batch_size)
        return ReplayBufferSamples(*(th.from_numpy(column).to(self.device) for column in columns))

    def minibatch(self, batch_size: int) -> Minibatch:
        """Draw relabelled transitions, as :meth:`sample` does.

        :param batch_size: number of transitions
        """
        rng, store = self.rng, self.store
        if self.rule.termination is None:  # an option that is given its goal learns from everything
            n_own = batch_size
            rows = rng.integers(store.oldest, store.total, size=batch_size)
            imagined = rng.random(batch_size) < self.hindsight
        else:
            own = self._readable()
            n_own = batch_size - int(self.shared * batch_size) if len(own) else 0
            own_rows = own[rng.integers(0, len(own), size=n_own)] if n_own else own[:0]
            rows = np.concatenate([own_rows, rng.integers(store.oldest, store.total, size=batch_size - n_own)])
            imagined = np.ones(batch_size, dtype=bool)
            imagined[:n_own] = rng.random(n_own) < self.hindsight
        data = store.read(rows)
        # Each transition has the goal that was pursued, or the one that its option is for now
        goal, next_achieved_goal = data["goal"], data["next_achieved_goal"]
        if self.aim is not None:
            goal[:] = self.aim()
        # What was achieved on the way to getting stuck would make that way look safe: it all came before.
        doomed = store.doomed(rows, self.doomed_steps)
        imagined[:n_own] &= ~doomed[:n_own]
        # Hindsight: a goal that was achieved later on the same trajectory
        relabelled = imagined & ~doomed
        later = store.future(rows[relabelled], self.horizon, rng)
        goal[relabelled] = store.column("next_achieved_goal", later)
        # Reward and end follow from the goal, not from what the environment said
        reached, stuck = self.rule.reached(next_achieved_goal, goal, imagined), store.stuck(rows)
        over = reached | stuck | store.terminated(rows)
        rewards = self.rule.reward(reached, over, stuck, data["achieved_goal"], next_achieved_goal, goal)
        return Minibatch(
            observations=self.view(data["observation"], data["achieved_goal"], goal),
            actions=data["action"],
            next_observations=self.view(data["next_observation"], next_achieved_goal, goal),
            dones=over.astype(np.float32)[:, None],
            rewards=rewards[:, None],
        )

    def get_state(self) -> dict[str, Any]:
        """Return the row numbers that can still be read."""
        return {"rows": self._readable()}

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`get_state` returned."""
        self._n_rows = 0
        self.add_rows(np.array(state["rows"], dtype=np.int64))


def draw(buffer: ReplayBuffer, batch_size: int, env: VecNormalize | None) -> Minibatch:
    """Draw a minibatch from any buffer, as its ``sample`` does.

    :param buffer: of an SB3 model
    :param batch_size: number of transitions
    :param env: normalises, if there is such a thing
    """
    if isinstance(buffer, OptionReplay):
        return buffer.minibatch(batch_size)
    if type(buffer) is not ReplayBuffer or buffer.optimize_memory_usage or env is not None:
        columns: list[Any] = [None if column is None else column.numpy() for column in buffer.sample(batch_size, env=env)]
        return Minibatch(*columns)
    # What SB3's own does, without its tensors; a choice of one environment draws nothing from the generator
    n_envs = buffer.n_envs
    at = np.random.randint(0, buffer.buffer_size if buffer.full else buffer.pos, size=batch_size)  # noqa: NPY002
    if n_envs > 1:
        at = at * n_envs + np.random.randint(0, n_envs, size=batch_size)  # noqa: NPY002

    def rows(column: np.ndarray) -> np.ndarray:
        return column.reshape(len(column) * n_envs, *(column.shape[2:] or (1,))).take(at, axis=0)

    dones = rows(buffer.dones) * (1 - rows(buffer.timeouts))
    seen = rows(buffer.observations), rows(buffer.actions), rows(buffer.next_observations)
    return Minibatch(*seen, dones, rows(buffer.rewards))
