"""One memory of transitions for all options, and the relabelled view of it that each option learns from."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

_COLUMNS = ("observation", "achieved_goal", "next_observation", "next_achieved_goal", "action", "goal")


class TransitionStore:
    """Ring memory of environment transitions, written once and read by every option.

    Rows are numbered from 0 in the order of writing and keep their number for good; a row can be read until
    ``capacity`` newer ones have been written. Parallel environments write one row each per step, so the successor of a
    row on its trajectory is ``n_envs`` rows later.

    :param capacity: number of transitions kept (rounded down to a multiple of ``n_envs``)
    :param observation_dim: length of the flat observation
    :param goal_dim: dimension of goal space
    :param action_dim: length of the action
    :param n_envs: number of environments
    """

    def __init__(self, capacity: int, observation_dim: int, goal_dim: int, action_dim: int, n_envs: int = 1) -> None:
        self.capacity = max(capacity // n_envs, 1) * n_envs
        self.n_envs = n_envs
        self.action_dim = action_dim
        self.total = 0
        ends = np.cumsum([observation_dim, goal_dim, observation_dim, goal_dim, action_dim, goal_dim]).tolist()
        self._slices = {name: slice(start, end) for name, start, end in zip(_COLUMNS, [0, *ends], ends, strict=False)}
        # All columns side by side: a minibatch is gathered once. np.zeros is lazy: memory is taken as rows are written.
        self._data = np.zeros((self.capacity, ends[-1]), dtype=np.float32)
        self._terminated = np.zeros(self.capacity, dtype=bool)
        self._stuck = np.zeros(self.capacity, dtype=bool)
        self._trajectory = np.zeros(self.capacity, dtype=np.int64)
        self._current = np.arange(n_envs, dtype=np.int64)
        self._n_trajectories = n_envs
        self._last_row = np.full(1024, -1, dtype=np.int64)  # of each trajectory

    def __len__(self) -> int:
        return min(self.total, self.capacity)

    @property
    def oldest(self) -> int:
        """Number of the oldest row that can still be read."""
        return self.total - len(self)

    def add(
        self,
        observation: np.ndarray,
        achieved_goal: np.ndarray,
        next_observation: np.ndarray,
        next_achieved_goal: np.ndarray,
        action: np.ndarray,
        goal: np.ndarray,
        terminated: np.ndarray,
        done: np.ndarray,
        stuck: np.ndarray | None = None,
    ) -> np.ndarray:
        """Write one transition per environment.

        :param observation: shape ``(n_envs, observation_dim)``
        :param achieved_goal: shape ``(n_envs, goal_dim)``
        :param next_observation: the observation that followed, the terminal one at an episode's end
        :param next_achieved_goal: likewise
        :param action: scaled to [-1, 1], shape ``(n_envs, action_dim)``
        :param goal: the goal that was pursued, shape ``(n_envs, goal_dim)``
        :param terminated: whether the environment ended for good (a time limit is no such end), shape ``(n_envs,)``
        :param done: whether the episode ended for any reason, shape ``(n_envs,)``
        :param stuck: whether it was given up since the agent was stuck, shape ``(n_envs,)``; None for none
        :return: the numbers of the rows written, shape ``(n_envs,)``
        """
        position = self.total % self.capacity
        block = slice(position, position + self.n_envs)
        values = (observation, achieved_goal, next_observation, next_achieved_goal, action, goal)
        np.concatenate(values, axis=1, out=self._data[block])
        self._terminated[block] = terminated
        self._stuck[block] = False if stuck is None else stuck
        self._trajectory[block] = self._current
        rows = np.arange(self.total, self.total + self.n_envs)
        while self._n_trajectories > len(self._last_row):
            self._last_row = np.concatenate([self._last_row, np.full_like(self._last_row, -1)])
        self._last_row[self._current] = rows
        if done.any():
            n_done = int(np.count_nonzero(done))
            self._current[done] = np.arange(self._n_trajectories, self._n_trajectories + n_done)
            self._n_trajectories += n_done
        self.total += self.n_envs
        return rows

    def column(self, name: str, rows: np.ndarray) -> np.ndarray:
        """Read one column.

        :param name: ``observation``, ``achieved_goal``, ``next_observation``, ``next_achieved_goal``, ``action``,
            ``goal``
        :param rows: row numbers, none older than :attr:`oldest`
        :return: float32 array of shape ``(len(rows), dim)``
        """
        return self._data[rows % self.capacity, self._slices[name]]

    def read(self, rows: np.ndarray) -> dict[str, np.ndarray]:
        """Read all columns, at the cost of one.

        :param rows: row numbers, none older than :attr:`oldest`
        :return: by name what :meth:`column` returns
        """
        data = self._data[rows % self.capacity]
        return {name: data[:, columns] for name, columns in self._slices.items()}

    def terminated(self, rows: np.ndarray) -> np.ndarray:
        """Tell after which rows the environment ended for good, shape ``(len(rows),)``."""
        return self._terminated[rows % self.capacity]

    def stuck(self, rows: np.ndarray) -> np.ndarray:
        """Tell after which rows the agent was stuck, shape ``(len(rows),)``."""
        return self._stuck[rows % self.capacity]

    def doomed(self, rows: np.ndarray, within: int) -> np.ndarray:
        """Tell which rows lie at most so many steps before the agent got stuck, shape ``(len(rows),)``.

        :param rows: row numbers
        :param within: number of steps
        """
        last = self._last_row[self._trajectory[rows % self.capacity]]
        return self.stuck(last) & ((last - rows) // self.n_envs < within)

    def cut(self) -> None:
        """End every running trajectory: what is written next does not follow from what was written last."""
        self._current = np.arange(self._n_trajectories, self._n_trajectories + self.n_envs, dtype=np.int64)
        self._n_trajectories += self.n_envs

    def future(self, rows: np.ndarray, horizon: int, rng: np.random.Generator) -> np.ndarray:
        """Draw, for each row, a row on the same trajectory that is not earlier.

        :param rows: row numbers
        :param horizon: how many steps ahead to look at most
        :param rng: random generator
        :return: row numbers
        """
        last = self._last_row[self._trajectory[rows % self.capacity]]
        ahead = np.minimum((last - rows) // self.n_envs, horizon - 1)
        return rows + rng.integers(0, ahead + 1) * self.n_envs

    def get_state(self) -> dict[str, Any]:
        """Return the filled rows and the counters as plain data."""
        rows = np.arange(self.oldest, self.total)
        return {
            "total": self.total,
            "n_envs": self.n_envs,
            "capacity": self.capacity,
            "columns": {name: self.column(name, rows) for name in _COLUMNS},
            "terminated": self.terminated(rows),
            "stuck": self.stuck(rows),
            "trajectory": self._trajectory[rows % self.capacity],
            "current": self._current,
            "n_trajectories": self._n_trajectories,
            "last_row": self._last_row[: self._n_trajectories],
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`get_state` returned.

        :raises ValueError: if the stored rows do not fit this store
        """
        expected = self.get_state().keys()
        if state.keys() != expected or not isinstance(state["columns"], dict) or set(state["columns"]) != set(_COLUMNS):
            raise ValueError(
                f"A stored replay buffer has the entries {', '.join(expected)}; here are {', '.join(map(str, state))}."
            )
        for name in ("n_envs", "capacity"):
            if state[name] != getattr(self, name):
                raise ValueError(
                    f"The stored replay buffer has {name}={state[name]}, this agent {name}={getattr(self, name)}: "
                    "load it into an agent made with the same buffer_size and number of environments."
                )
        for name in _COLUMNS:
            own, stored = self._data[:1, self._slices[name]].shape[1:], np.shape(state["columns"][name])[1:]
            if stored != own:
                raise ValueError(
                    f"The stored replay buffer has {name} of shape {stored}, this agent's environment gives {own}."
                )
        self._check_rows(state)
        self.total = int(state["total"])
        at = np.arange(self.oldest, self.total) % self.capacity
        for name in _COLUMNS:
            self._data[at, self._slices[name]] = state["columns"][name]
        self._terminated[at] = state["terminated"]
        self._stuck[at] = state["stuck"]
        self._trajectory[at] = state["trajectory"]
        self._current = np.array(state["current"])
        self._n_trajectories = int(state["n_trajectories"])
        self._last_row = np.array(state["last_row"])
        if len(self._last_row) == 0:
            self._last_row = np.full(1024, -1, dtype=np.int64)

    def _check_rows(self, state: dict[str, Any]) -> None:
        """Refuse rows and counters that do not belong together."""
        total, n_trajectories = state["total"], state["n_trajectories"]
        if not (isinstance(total, int) and isinstance(n_trajectories, int) and 0 <= total < 2**62 and n_trajectories >= 0):
            raise ValueError(f"The stored replay buffer counts {total!r} rows of {n_trajectories!r} trajectories.")
        n = min(total, self.capacity)
        shapes = {"terminated": (n,), "stuck": (n,), "trajectory": (n,), "current": (self.n_envs,)}
        for name, shape in shapes.items():
            if np.shape(state[name]) != shape or np.asarray(state[name]).dtype.kind not in "bi":
                raise ValueError(f"The stored replay buffer has no {name} of shape {shape}.")
        if any(len(state["columns"][name]) != n for name in _COLUMNS):
            raise ValueError(f"The columns of the stored replay buffer have not {n} rows each.")
        last = np.asarray(state["last_row"])
        if last.ndim != 1 or last.dtype.kind != "i" or len(last) > n_trajectories:
            raise ValueError(f"The stored replay buffer has no last rows of {n_trajectories} trajectories.")
        numbers = np.concatenate([state["trajectory"], state["current"]])
        if n and not (numbers.min() >= 0 and np.asarray(state["trajectory"]).max() < len(last) and last.max() < total):
            raise ValueError("The trajectories of the stored replay buffer are not those of its rows.")


def as_rows(before: dict[str, np.ndarray], action: np.ndarray, after: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return one step of one environment as :meth:`TransitionStore.add` takes it, without its ends.

    :param before: the observation before the step
    :param action: scaled to [-1, 1]
    :param after: the observation after it
    :return: arrays of shape ``(1, dim)`` by name
    """
    row = {
        "observation": before["observation"],
        "achieved_goal": before["achieved_goal"],
        "next_observation": after["observation"],
        "next_achieved_goal": after["achieved_goal"],
        "action": action,
        "goal": before["desired_goal"],
    }
    return {name: np.asarray(value).reshape(1, -1) for name, value in row.items()}


class OptionRule(NamedTuple):
    """What an option is paid for and where it ends (section 2.1): -1 a step, and 0 on reaching its goal, which ends it.

    Where the agent gets stuck it pays what standing there forever would.

    ``reached(next_achieved_goal, goal, imagined)`` returns a bool array of shape ``(n,)``; ``imagined`` marks the
    transitions whose goal was put in by hindsight, for which reaching means coming within the radius of that goal.

    :param reached: tells which transitions reach the goal
    :param gamma: discount factor
    :param shaping: further reward for a goal unit of distance gained; it is the change of a potential (Ng et al., 1999),
        which changes no policy's rank
    """

    reached: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
    gamma: float = 0.99
    shaping: float = 0.0

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
            potential = self.gamma * np.linalg.norm(after - goal, axis=1) * ~over
            reward += self.shaping * (np.linalg.norm(before - goal, axis=1) - potential)
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
    :param everything: whether all rows of the store count as the option's own (the global option)
    :param hindsight: share of own transitions that take an achieved goal
    :param shared: share of a batch that comes from the whole store
    :param horizon: steps ahead from which an achieved goal is drawn
    :param doomed_steps: steps before the agent got stuck in which no goal is put in
    :param capacity: number of own row numbers kept
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
        everything: bool = False,
        hindsight: float = 0.8,
        shared: float = 0.5,
        horizon: int = 200,
        doomed_steps: int = 50,
        capacity: int = 100_000,
        device: th.device | str = "auto",
    ) -> None:
        # SB3's constructor allocates buffer_size rows of its own; the shared store holds ours.
        super().__init__(1, observation_space, action_space, device=device, handle_timeout_termination=False)
        self.store = store
        self.view = view
        self.rule = rule
        self.rng = rng
        self.everything = everything
        self.hindsight = hindsight
        self.shared = shared
        self.horizon = horizon
        self.doomed_steps = doomed_steps
        self.buffer_size = capacity
        self._rows = np.zeros(256, dtype=np.int64)
        self._n_rows = 0

    def size(self) -> int:
        """Return how many transitions of its own the option can learn from."""
        return len(self.store) if self.everything else len(self._readable())

    def add_rows(self, rows: np.ndarray) -> None:
        """Remember rows on which the option ran.

        :param rows: row numbers of the store, ascending
        """
        needed = self._n_rows + len(rows)
        if needed > self.buffer_size:
            kept = self._rows[: self._n_rows][-(self.buffer_size // 2) :]
            self._rows[: len(kept)] = kept
            self._n_rows = len(kept)
            needed = self._n_rows + len(rows)
        while needed > len(self._rows):
            self._rows = np.concatenate([self._rows, np.zeros_like(self._rows)])
        self._rows[self._n_rows : needed] = rows
        self._n_rows = needed

    def _readable(self) -> np.ndarray:
        rows = self._rows[: self._n_rows]
        return rows[np.searchsorted(rows, self.store.oldest) :]

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> ReplayBufferSamples:
        """Draw relabelled transitions.

        :param batch_size: number of transitions
        :param env: not used; sets live in raw goal space, so observations are not normalised
        :return: tensors of shape ``(batch_size, ...)``
        """
        rng, store = self.rng, self.store
        if self.everything:
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
        goal, next_achieved_goal = data["goal"], data["next_achieved_goal"]
        # What was achieved on the way to getting stuck would make that way look safe: it all came before.
        doomed = store.doomed(rows, self.doomed_steps)
        imagined[:n_own] &= ~doomed[:n_own]
        relabelled = imagined & ~doomed
        later = store.future(rows[relabelled], self.horizon, rng)
        goal[relabelled] = store.column("next_achieved_goal", later)
        reached, stuck = self.rule.reached(next_achieved_goal, goal, imagined), store.stuck(rows)
        over = reached | stuck | store.terminated(rows)
        rewards = self.rule.reward(reached, over, stuck, data["achieved_goal"], next_achieved_goal, goal)
        return ReplayBufferSamples(
            observations=self._tensor(self.view(data["observation"], data["achieved_goal"], goal)),
            actions=self._tensor(data["action"]),
            next_observations=self._tensor(self.view(data["next_observation"], next_achieved_goal, goal)),
            dones=self._tensor(over.astype(np.float32)[:, None]),
            rewards=self._tensor(rewards[:, None]),
        )

    def _tensor(self, array: np.ndarray) -> th.Tensor:
        return th.from_numpy(array).to(self.device)

    def get_state(self) -> dict[str, Any]:
        """Return the row numbers that can still be read."""
        return {"rows": self._readable()}

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`get_state` returned."""
        self._n_rows = 0
        self.add_rows(np.array(state["rows"], dtype=np.int64))
