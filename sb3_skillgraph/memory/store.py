"""The memory of all transitions: written once, read through relabelled views."""

from typing import Any

import numpy as np

from sb3_skillgraph.checking import anything, array, entries, whole

_FLAGS = ("terminated", "stuck")
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
        self.observation_dim, self.goal_dim, self.action_dim = observation_dim, goal_dim, action_dim
        self.total = 0
        ends = np.cumsum([observation_dim, goal_dim, observation_dim, goal_dim, action_dim, goal_dim]).tolist()
        self._slices = {name: slice(start, end) for name, start, end in zip(_COLUMNS, [0, *ends], ends, strict=False)}
        # All columns side by side: a minibatch is gathered once. np.zeros is lazy: memory is taken as rows are written.
        self._data = np.zeros((self.capacity, ends[-1]), dtype=np.float32)
        self._terminated = np.zeros(self.capacity, dtype=bool)
        self._stuck = np.zeros(self.capacity, dtype=bool)
        self._trajectory = np.zeros(self.capacity, dtype=np.int64)
        self._current = np.zeros(n_envs, dtype=np.int64)
        self._n_trajectories = 0
        self._last_row = np.full(1024, -1, dtype=np.int64)  # of each trajectory
        self.cut()

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
        self._last_row[self._current] = rows
        if done.any():
            self._begin_trajectories(done)
        self.total += self.n_envs
        return rows

    def _begin_trajectories(self, where: np.ndarray) -> None:
        """Let other trajectories begin in some environments, bool array of shape ``(n_envs,)``."""
        before, self._n_trajectories = self._n_trajectories, self._n_trajectories + int(np.count_nonzero(where))
        self._current[where] = np.arange(before, self._n_trajectories)
        while self._n_trajectories > len(self._last_row):
            self._last_row = np.concatenate([self._last_row, np.full_like(self._last_row, -1)])

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

    def trajectory(self, rows: np.ndarray) -> np.ndarray:
        """Return the numbers of the trajectories that rows are of, shape ``(len(rows),)``."""
        return self._trajectory[rows % self.capacity]

    def is_running(self, trajectories: np.ndarray) -> np.ndarray:
        """Tell which trajectories are not over, bool array of the same shape."""
        return np.isin(trajectories, self._current)

    def doomed(self, rows: np.ndarray, within: int) -> np.ndarray:
        """Tell which rows lie at most so many steps before the agent got stuck, shape ``(len(rows),)``.

        :param rows: row numbers
        :param within: number of steps
        """
        last = self._last_row[self.trajectory(rows)]
        return self.stuck(last) & ((last - rows) // self.n_envs < within)

    def cut(self) -> None:
        """End every running trajectory: what is written next does not follow from what was written last."""
        self._begin_trajectories(np.ones(self.n_envs, dtype=bool))

    def future(self, rows: np.ndarray, horizon: int, rng: np.random.Generator) -> np.ndarray:
        """Draw, for each row, a row on the same trajectory that is not earlier.

        :param rows: row numbers
        :param horizon: how many steps ahead to look at most
        :param rng: random generator
        :return: row numbers
        """
        last = self._last_row[self.trajectory(rows)]
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
            "trajectory": self.trajectory(rows),
            "current": self._current,
            "n_trajectories": self._n_trajectories,
            "last_row": self._last_row[: self._n_trajectories],
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`get_state` returned.

        :raises ValueError: if the stored rows do not fit this store
        """
        self._check(state)
        self.total = int(state["total"])
        at = np.arange(self.oldest, self.total) % self.capacity
        for name in _COLUMNS:
            self._data[at, self._slices[name]] = state["columns"][name]
        self._terminated[at] = state["terminated"]
        self._stuck[at] = state["stuck"]
        self._trajectory[at] = state["trajectory"]
        self._current = np.array(state["current"], dtype=np.int64)
        self._n_trajectories = int(state["n_trajectories"])
        self._last_row = np.array(state["last_row"], dtype=np.int64)

    def _check(self, state: Any) -> None:
        """Refuse rows and counters that do not fit this store, or do not belong together."""
        where = "The stored replay buffer"
        names = ("total", "n_envs", "capacity", "columns", *_FLAGS, "trajectory", "current", "n_trajectories", "last_row")
        counts = {"total": whole(), "n_trajectories": whole(1)}
        entries(**{name: counts.get(name, anything) for name in names})(state, where)
        for name in ("n_envs", "capacity"):
            if state[name] != getattr(self, name):
                raise ValueError(
                    f"The stored replay buffer has {name}={state[name]}, this agent {name}={getattr(self, name)}: "
                    "load it into an agent made with the same buffer_size and number of environments."
                )
        total, n_trajectories = state["total"], state["n_trajectories"]
        n = min(total, self.capacity)
        widths = {name: own.stop - own.start for name, own in self._slices.items()}
        entries(
            True,
            columns=entries(**{name: array((n, width)) for name, width in widths.items()}),
            **{name: array((n,), "b") for name in _FLAGS},
            trajectory=array((n,), "i", 0, n_trajectories - 1),
            current=array((self.n_envs,), "i", 0, n_trajectories - 1),
            last_row=array((n_trajectories,), "i", high=total - 1),
        )(state, where)
        ahead = state["last_row"][state["trajectory"]] - np.arange(total - n, total)
        if not ((ahead >= 0) & (ahead % self.n_envs == 0)).all():
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
