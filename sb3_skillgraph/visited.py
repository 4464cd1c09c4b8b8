"""Where the agent has been, in goal space, and how long it took from one place to the next."""

import math
from typing import Any, NamedTuple

import numpy as np

BACKWARDS = 1.5  # a step against the direction a trajectory was walked in is worth so many in it


class _Place(NamedTuple):
    """Where an agent was found, in which event, and how far it can move before that must be looked at again."""

    point: list[float]
    event: int
    slack: float


_NOWHERE = _Place([], -1, 0.0)  # not looked at yet


class VisitedStates:
    """Trajectories through goal space, thinned to one point per ``spacing``.

    Three parts of the algorithm read it: salience proposes events on visited states (section 3.2.1), the planner asks
    which event the agent had last passed when it came near a goal (section 3.2.3: nearness in steps, which walls
    cannot fool as they fool the Euclidean distance), and the logger asks how much of the visited space the graph covers.

    Every point carries the label of the event it lies in (``-1`` for none). When the memory is full, its older half
    is forgotten.

    :param goal_dim: dimension of goal space
    :param spacing: distance the agent must move before another point is kept, in goal units
    :param n_envs: number of environments that write trajectories
    :param capacity: number of points kept
    """

    def __init__(self, goal_dim: int, spacing: float, n_envs: int = 1, capacity: int = 200_000) -> None:
        self.goal_dim = goal_dim
        self.spacing = spacing
        self.capacity = capacity
        self.size = 0
        self.n_forgotten = 0
        self._points = np.zeros((1024, goal_dim), dtype=np.float32)
        self._trajectory = np.zeros(1024, dtype=np.int64)
        self._step = np.zeros(1024, dtype=np.int64)
        self._label = np.zeros(1024, dtype=np.int32)
        self._current = np.arange(n_envs, dtype=np.int64)  # trajectory that each env is writing
        self._last_point = np.full((n_envs, goal_dim), np.nan, dtype=np.float32)
        self._n_trajectories = n_envs
        self._centers = np.zeros((0, goal_dim), dtype=np.float64)
        self._radii = np.zeros(0, dtype=np.float64)
        self._passed: dict[tuple[int, ...], tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]] = {}
        self._places = [_NOWHERE] * n_envs

    @property
    def points(self) -> np.ndarray:
        """Visited points, shape ``(size, goal_dim)``, oldest first."""
        return self._points[: self.size]

    def record(self, env_index: int, step: int, point: np.ndarray, done: bool = False) -> None:
        """Extend the trajectory of one environment.

        :param env_index: which environment
        :param step: environment step at which the point was reached (any clock that counts steps)
        :param point: position in goal space, shape ``(goal_dim,)``
        :param done: whether the trajectory ends here
        """
        coordinates = point.tolist()
        label = self._locate(env_index, coordinates)
        # NaN, before the first point, counts as moved.
        if done or not math.dist(coordinates, self._last_point[env_index].tolist()) < self.spacing:
            self._append(env_index, step, point, label)
        if done:
            self._cut(env_index)

    def end(self, env_index: int) -> None:
        """End the trajectory of one environment where it was recorded last.

        :param env_index: which environment
        """
        self._places[env_index] = _NOWHERE
        self._cut(env_index)

    def cut(self, n_envs: int) -> None:
        """End every running trajectory: what is recorded next does not follow from what was recorded last.

        :param n_envs: number of environments from now on
        """
        self._current = np.zeros(n_envs, dtype=np.int64)
        self._last_point = np.zeros((n_envs, self.goal_dim), dtype=np.float32)
        self._places = [_NOWHERE] * n_envs
        for env_index in range(n_envs):
            self._cut(env_index)

    def _cut(self, env_index: int) -> None:
        self._current[env_index] = self._n_trajectories
        self._n_trajectories += 1
        self._last_point[env_index] = np.nan

    def event(self, env_index: int) -> int:
        """Return the index of the event that the point recorded last for an environment lies in, ``-1`` for none."""
        return self._places[env_index].event

    def _locate(self, env_index: int, coordinates: list[float]) -> int:
        place = self._places[env_index]
        if math.dist(coordinates, place.point or coordinates) >= place.slack:
            place = self._places[env_index] = self._place(coordinates)
        return place.event

    def _place(self, coordinates: list[float]) -> "_Place":
        if len(self._radii) == 0:
            return _Place(coordinates, -1, math.inf)
        offsets = self._centers - coordinates
        distances = np.sqrt(np.einsum("ij,ij->i", offsets, offsets))
        outside = distances - self._radii
        inside = outside <= 0.0
        if not inside.any():
            return _Place(coordinates, -1, float(outside.min()))
        event = int(np.where(inside, distances, np.inf).argmin())
        # Another event can become the nearest one after half of what it is further away.
        rivals = 0.5 * (np.delete(distances, event) - distances[event])
        return _Place(coordinates, event, min(float(-outside[event]), float(rivals.min(initial=np.inf))))

    def _append(self, env_index: int, step: int, point: np.ndarray, label: int) -> None:
        if self.size >= self.capacity:
            self._forget_older_half()
        if self.size == len(self._step):
            grown = max(1024, 2 * self.size)
            for name in ("_points", "_trajectory", "_step", "_label"):
                array = getattr(self, name)
                more = np.zeros((grown - self.size, *array.shape[1:]), dtype=array.dtype)
                setattr(self, name, np.concatenate([array, more]))
        i = self.size
        self._points[i] = point
        self._trajectory[i] = self._current[env_index]
        self._step[i] = step
        self._label[i] = label
        self._last_point[env_index] = point
        self.size += 1
        self._passed.clear()

    def _forget_older_half(self) -> None:
        keep = slice(self.size // 2, self.size)
        n = self.size - self.size // 2
        self.n_forgotten += self.size - n
        for name in ("_points", "_trajectory", "_step", "_label"):
            array = getattr(self, name)
            array[:n] = array[keep].copy()
        self.size = n

    def set_events(self, centers: np.ndarray, radii: np.ndarray) -> None:
        """Relabel the points after the list of events has changed.

        :param centers: shape ``(n_events, goal_dim)``
        :param radii: shape ``(n_events,)``
        """
        self._centers = np.asarray(centers, dtype=np.float64).reshape(-1, self.goal_dim)
        self._radii = np.asarray(radii, dtype=np.float64)
        self._label[: self.size] = self.label(self.points)
        self._passed.clear()
        self._places = [_NOWHERE] * len(self._current)

    def label(self, points: np.ndarray) -> np.ndarray:
        """Return the event each point lies in.

        :param points: shape ``(n, goal_dim)``
        :return: int array of shape ``(n,)``: index of the nearest event that contains the point, ``-1`` for none
        """
        best = np.full(len(points), -1, dtype=np.int32)
        nearest = np.full(len(points), np.inf)
        if len(points) <= 8:  # few points against many events
            if len(self._radii) == 0:
                return best
            offsets = np.asarray(points, dtype=np.float64)[:, None] - self._centers
            squared = np.einsum("ijk,ijk->ij", offsets, offsets)
            squared[squared > self._radii**2] = np.inf
            closest = squared.argmin(axis=1)
            return np.where(np.isfinite(squared[np.arange(len(points)), closest]), closest, -1).astype(np.int32)
        for k, (center, radius) in enumerate(zip(self._centers, self._radii, strict=True)):
            offsets = points - center
            squared = np.einsum("ij,ij->i", offsets, offsets)
            inside = (squared <= radius**2) & (squared < nearest)
            best[inside] = k
            nearest[inside] = squared[inside]
        return best

    def near(self, point: np.ndarray, radius: float, exact: bool = False) -> np.ndarray:
        """Return the indices of visited points within ``radius`` of a point; of the nearest one if there are none.

        :param point: shape ``(goal_dim,)``
        :param radius: distance in goal units
        :param exact: return none if there are none
        :return: int array
        """
        if self.size == 0:
            return np.zeros(0, dtype=np.int64)
        offsets = self.points - np.asarray(point, dtype=np.float32)
        squared = np.einsum("ij,ij->i", offsets, offsets)
        inside = np.flatnonzero(squared <= radius**2)
        return inside if len(inside) or exact else squared.argmin(keepdims=True)

    def _events_passed(self, without: tuple[int, ...] = ()) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """For each point: the last event before it on its trajectory, steps since; the next one, steps until.

        :param without: indices of events that count as none
        """
        if without not in self._passed:
            n = self.size
            # Trajectories of parallel environments interleave: walk them one after the other.
            order = np.lexsort((self._step[:n], self._trajectory[:n]))
            trajectory, step = self._trajectory[:n][order], self._step[:n][order]
            label = np.where(np.isin(self._label[:n], without), -1, self._label[:n])[order]
            position = np.arange(n)
            before = np.maximum.accumulate(np.where(label >= 0, position, -1))
            after = np.minimum.accumulate(np.where(label >= 0, position, n)[::-1])[::-1]
            columns: list[np.ndarray] = []
            for pointer, exists in ((before, before >= 0), (after, after < n)):
                pointer = np.where(exists, pointer, 0)
                exists = exists & (trajectory[pointer] == trajectory)
                event = np.empty(n, dtype=np.int32)
                steps = np.empty(n, dtype=np.int64)
                event[order] = np.where(exists, label[pointer], -1)
                steps[order] = np.abs(step - step[pointer])
                columns += [event, steps]
            self._passed[without] = (columns[0], columns[1], columns[2], columns[3])
        return self._passed[without]

    def events_before(self, point: np.ndarray, radius: float, without: tuple[int, ...] = ()) -> dict[int, int]:
        """Return the events last passed on the way to a point, with the fewest steps from each.

        :param point: shape ``(goal_dim,)``
        :param radius: how near a trajectory must come to the point, in goal units
        :param without: indices of events that count as none
        :return: event index -> steps, fewest first
        """
        event, steps, _, _ = self._events_passed(without)
        return _fewest(event, steps, self.near(point, radius))

    def events_after(self, point: np.ndarray, radius: float, without: tuple[int, ...] = ()) -> dict[int, int]:
        """Return the events reached next from a point, with the fewest steps to each.

        :param point: shape ``(goal_dim,)``
        :param radius: how near a trajectory must come to the point, in goal units
        :param without: indices of events that count as none
        :return: event index -> steps, fewest first
        """
        _, _, event, steps = self._events_passed(without)
        return _fewest(event, steps, self.near(point, radius))

    def steps_between(self, start: np.ndarray, goal: np.ndarray, radii: tuple[float, float]) -> float:
        """Return the fewest steps any trajectory took from near one point to near another.

        :param start: shape ``(goal_dim,)``
        :param goal: shape ``(goal_dim,)``
        :param radii: how near a trajectory must come to the start, and how near to the goal, in goal units
        :return: environment steps; ``inf`` if no trajectory passed both in this order
        """
        departure, arrival = self._passage(self.near(start, radii[0], exact=True), self.near(goal, radii[1], exact=True))
        return float("inf") if departure < 0 else float(self._step[arrival] - self._step[departure])

    def waypoint(self, start: np.ndarray, goal: np.ndarray, radii: tuple[float, float], ahead: int) -> int:
        """Find the next point to walk to on the quickest way any trajectory took from near one point to near another.

        Or backwards along one that came the other way, where that is much shorter, or none went this way.

        :param start: shape ``(goal_dim,)``
        :param goal: shape ``(goal_dim,)``
        :param radii: how near a trajectory must come to the start, and how near to the goal; the waypoint must be further
            from the start than the latter
        :param ahead: environment steps the trajectory took to the waypoint at least
        :return: number of a visited point (see :meth:`point`); ``-1`` if the goal itself is as near, or no trajectory
            leads there
        """
        here, there = self.near(start, radii[0]), self.near(goal, radii[1])
        step, trajectory = self._step[: self.size], self._trajectory[: self.size]
        departure, arrival = self._passage(here, there)
        begin, end = self._passage(there, here)
        if begin >= 0 and (departure < 0 or BACKWARDS * (step[end] - step[begin]) < step[arrival] - step[departure]):
            departure, arrival, step = end, begin, -step
        if departure < 0:
            return -1
        way = (trajectory == trajectory[departure]) & (step >= step[departure] + ahead) & (step < step[arrival])
        indices = np.flatnonzero(way)
        far = np.linalg.norm(self.points[indices] - start, axis=1) > radii[1]
        indices = indices[far]
        return self.n_forgotten + int(indices[step[indices].argmin()]) if len(indices) else -1

    def point(self, number: int) -> np.ndarray:
        """Return a visited point by its number, counted from the first ever visited; shape ``(goal_dim,)``."""
        return self.points[max(number - self.n_forgotten, 0)].astype(np.float64)

    def _passage(self, here: np.ndarray, there: np.ndarray) -> tuple[int, int]:
        """Return from which of some points to which of others a trajectory went quickest, ``-1`` if none did."""
        if len(here) == 0 or len(there) == 0:
            return -1, -1
        # One sortable key for (trajectory, step): the first passage of the goal after each passage of the start.
        span = int(self._step[: self.size].max()) + 1
        key = self._trajectory[: self.size] * span + self._step[: self.size]
        there = there[np.argsort(key[there], kind="stable")]
        following = np.searchsorted(key[there], key[here])
        here, following = here[following < len(there)], following[following < len(there)]
        arrivals = there[following]
        same = self._trajectory[here] == self._trajectory[arrivals]
        here, arrivals = here[same], arrivals[same]
        if len(here) == 0:
            return -1, -1
        best = int((self._step[arrivals] - self._step[here]).argmin())
        return int(here[best]), int(arrivals[best])

    def path_from(self, event: int, point: np.ndarray, radius: float) -> np.ndarray:
        """Return the quickest way any trajectory took from an event to near a point.

        :param event: index of the event that was last passed
        :param point: shape ``(goal_dim,)``
        :param radius: how near a trajectory must come to the point, in goal units
        :return: visited points, shape ``(n, goal_dim)``; empty if no trajectory came from there
        """
        before, steps, _, _ = self._events_passed()
        here = self.near(point, radius)
        here = here[before[here] == event]
        if len(here) == 0:
            return np.zeros((0, self.goal_dim))
        end = here[steps[here].argmin()]
        n = self.size
        way = (self._trajectory[:n] == self._trajectory[end]) & (self._step[:n] <= self._step[end])
        way &= self._step[:n] >= self._step[end] - steps[end]
        return self.points[np.flatnonzero(way)].astype(np.float64)

    def rewind(self, index: int, max_steps: int) -> int:
        """Walk back along a trajectory until at most ``max_steps`` lie behind the last event passed.

        :param index: index of a visited point
        :param max_steps: environment steps
        :return: index of a visited point on the same trajectory, not later than ``index``
        """
        event, steps, _, _ = self._events_passed()
        if event[index] < 0:
            return index
        n = self.size
        same = np.flatnonzero(
            (self._trajectory[:n] == self._trajectory[index])
            & (self._step[:n] <= self._step[index])
            & (self._step[:n] >= self._step[index] - steps[index])
            & (steps <= max_steps)
        )
        return int(same[self._step[same].argmax()]) if len(same) else index

    def get_state(self) -> dict[str, Any]:
        """Return the memory as plain data."""
        n = self.size
        return {
            "points": self._points[:n],
            "trajectory": self._trajectory[:n],
            "step": self._step[:n],
            "current": self._current,
            "last_point": self._last_point,
            "n_trajectories": self._n_trajectories,
            "n_forgotten": self.n_forgotten,
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`get_state` returned; the events must be set again afterwards."""
        self._points = np.array(state["points"], dtype=np.float32).reshape(-1, self.goal_dim)
        self._trajectory = np.array(state["trajectory"], dtype=np.int64)
        self._step = np.array(state["step"], dtype=np.int64)
        self.size = len(self._step)
        self._label = np.full(self.size, -1, dtype=np.int32)
        self._current = np.array(state["current"], dtype=np.int64)
        self._last_point = np.array(state["last_point"], dtype=np.float32)
        self._n_trajectories, self.n_forgotten = int(state["n_trajectories"]), int(state["n_forgotten"])
        self._passed.clear()
        self._places = [_NOWHERE] * len(self._current)


def _fewest(event: np.ndarray, steps: np.ndarray, indices: np.ndarray) -> dict[int, int]:
    indices = indices[event[indices] >= 0]
    indices = indices[np.argsort(steps[indices], kind="stable")]
    fewest: dict[int, int] = {}
    for i in indices:
        fewest.setdefault(int(event[i]), int(steps[i]))
    return fewest
