import copy
from dataclasses import dataclass, field

import numpy as np
import pytest
from builders import profile
from hypothesis import given
from hypothesis import strategies as st

from sb3_skillgraph.visited import VisitedStates

SPACING = 1.0
#: One step of one environment: which, a displacement on a grid of half a unit, and whether the trajectory ends there.
Move = tuple[int, int, int, bool]
moves = st.lists(
    st.tuples(st.integers(0, 2), st.integers(-3, 3), st.integers(-3, 3), st.integers(0, 9).map(lambda k: k == 0)),
    min_size=1,
    max_size=60,
)
points = st.tuples(st.integers(-8, 8), st.integers(-8, 8)).map(lambda p: np.array(p) * 0.5)
radii = st.tuples(st.sampled_from([0.0, 0.6, 1.5]), st.sampled_from([0.0, 0.6, 1.5]))
CENTERS, RADII = np.array([[0.0, 0.0], [3.0, 0.5], [-3.0, -2.5], [3.5, 0.5]]), np.array([1.0, 1.5, 1.0, 1.0])


@dataclass
class Oracle:
    """What a memory must hold, as lists: (trajectory, step, point)."""

    kept: list[tuple[int, int, np.ndarray]] = field(default_factory=list)

    def label(self, point: np.ndarray) -> int:
        distances = np.linalg.norm(CENTERS - point, axis=1)
        inside = [k for k in range(len(CENTERS)) if distances[k] <= RADII[k]]
        return min(inside, key=lambda k: distances[k], default=-1)

    def near(self, point: np.ndarray, radius: float) -> list[int]:
        distances = [float(np.linalg.norm(p - point)) for _, _, p in self.kept]
        inside = [i for i, d in enumerate(distances) if d <= radius]
        return inside or [int(np.argmin(distances))]

    def passed(self, i: int, sign: int) -> tuple[int, int] | None:
        """The last event passed before a point (sign -1) or the next one after it (+1), and the steps between."""
        trajectory, step, _ = self.kept[i]
        same = [(s, p) for t, s, p in self.kept if t == trajectory and sign * (s - step) >= 0]
        labelled = [(abs(s - step), self.label(p)) for s, p in same if self.label(p) >= 0]
        if not labelled:
            return None
        steps, label = min(labelled)
        return label, steps

    def events(self, point: np.ndarray, radius: float, sign: int) -> dict[int, int]:
        fewest: dict[int, int] = {}
        for i in self.near(point, radius):
            found = self.passed(i, sign)
            if found is not None:
                fewest[found[0]] = min(found[1], fewest.get(found[0], 10**9))
        return fewest

    def steps_between(self, start: np.ndarray, goal: np.ndarray, radii: tuple[float, float]) -> float:
        here, there = self.near(start, radii[0]), self.near(goal, radii[1])
        steps = [
            self.kept[j][1] - self.kept[i][1]
            for i in here
            for j in there
            if self.kept[i][0] == self.kept[j][0] and self.kept[j][1] >= self.kept[i][1]
        ]
        return float(min(steps, default=np.inf))


def record_all(visited: VisitedStates, sequence: list[Move], *, labelled: bool = True, clock: int = 0) -> Oracle:
    """Record moves in the memory and, by the rule of the docstring, in an oracle."""
    if labelled:
        visited.set_events(CENTERS, RADII)
    oracle = Oracle()
    position = np.zeros((3, 2))
    last: list[np.ndarray | None] = [None] * 3
    trajectory, n_trajectories = [0, 1, 2], 3
    for k, (env, dx, dy, done) in enumerate(sequence):
        position[env] += 0.5 * np.array([dx, dy])
        point = position[env].copy()
        visited.record(env, clock + k, point.astype(np.float32), done)
        previous = last[env]
        if previous is None or done or np.linalg.norm(point - previous) >= SPACING:
            oracle.kept.append((trajectory[env], clock + k, point))
            last[env] = point
        if done:
            trajectory[env], last[env], position[env] = n_trajectories, None, 0.0
            n_trajectories += 1
    return oracle


@given(moves)
@profile(50)
def test_thinning_keeps_one_point_per_spacing(sequence: list[Move]) -> None:
    visited = VisitedStates(2, SPACING, n_envs=3)
    oracle = record_all(visited, sequence)
    np.testing.assert_array_equal(visited.points, np.stack([p for _, _, p in oracle.kept]))


@given(moves, points, st.sampled_from([0.0, 0.6, 1.5]))
@profile(80)
def test_events_before_and_after_agree_with_brute_force(sequence: list[Move], point: np.ndarray, radius: float) -> None:
    visited = VisitedStates(2, SPACING, n_envs=3)
    oracle = record_all(visited, sequence)
    for answer, sign in ((visited.events_before(point, radius), -1), (visited.events_after(point, radius), 1)):
        assert answer == oracle.events(point, radius, sign)
        assert list(answer.values()) == sorted(answer.values())  # fewest first


@given(moves, points, points, radii)
@profile(80)
def test_steps_between_agrees_with_brute_force(
    sequence: list[Move], start: np.ndarray, goal: np.ndarray, radii: tuple[float, float]
) -> None:
    visited = VisitedStates(2, SPACING, n_envs=3)
    oracle = record_all(visited, sequence)
    start, goal = (visited.points[np.linalg.norm(visited.points - end, axis=1).argmin()] for end in (start, goal))
    assert visited.steps_between(start, goal, radii) == oracle.steps_between(start, goal, radii)


@given(moves, points, points, radii, st.integers(0, 6))
@profile(120)
def test_a_waypoint_lies_ahead_on_the_quickest_way(
    sequence: list[Move], start: np.ndarray, goal: np.ndarray, radii: tuple[float, float], ahead: int
) -> None:
    """Forwards in time if any trajectory went that way, else backwards."""
    visited = VisitedStates(2, SPACING, n_envs=3)
    kept = (oracle := record_all(visited, sequence)).kept
    here, there = oracle.near(start, radii[0]), oracle.near(goal, radii[1])
    same = [(i, j) for i in here for j in there if kept[i][0] == kept[j][0]]
    forwards = [(i, j) for i, j in same if kept[j][1] >= kept[i][1]]
    time = 1 if forwards else -1
    steps = {(i, j): time * (kept[j][1] - kept[i][1]) for i, j in forwards or same}
    allowed = set()
    for i, j in (passage for passage, n in steps.items() if n == min(steps.values())):
        after = {k: time * (kept[k][1] - kept[i][1]) for k in range(len(kept)) if kept[k][0] == kept[i][0]}
        between = [k for k, n in after.items() if ahead <= n < steps[i, j]]
        between = [k for k in between if np.linalg.norm(kept[k][2] - start) > radii[1]]
        allowed.add(min(between, key=after.__getitem__, default=-1))
    assert visited.waypoint(start, goal, radii, ahead) in (allowed or {-1})


def test_waypoints_lead_around_a_corner_to_the_goal() -> None:
    visited = VisitedStates(2, SPACING)
    corridor = [(float(x), 0.0) for x in range(11)] + [(10.0, float(y)) for y in range(1, 11)]
    for step, point in enumerate(corridor):
        visited.record(0, step, np.array(point, dtype=np.float32))
    at, goal, passed = np.array([0.4, 0.3]), np.array([10.0, 10.0]), []
    while (k := visited.waypoint(at, goal, (0.5, 0.5), 4)) >= 0:
        passed.append(k)
        at = visited.points[k].astype(np.float64)
    assert passed == [4, 8, 12, 16]
    assert visited.waypoint(np.array([10.0, 7.0]), goal, (0.5, 0.5), 4) == -1  # the goal is as near
    assert visited.waypoint(np.array([-50.0, 0.0]), goal, (0.5, 0.5), 4) == 4  # from afar: by where the way begins
    assert visited.waypoint(goal, np.zeros(2), (0.5, 0.5), 4) == 16  # nobody went back: backwards by the way that came
    assert visited.waypoint(np.array([6.0, 1.2]), goal, (0.5, 0.5), 4) == 10  # not near any way: by the nearest point of one
    assert visited.waypoint(np.array([6.0, 1.2]), goal, (2.0, 0.5), 4) == 11  # near one: on from where it is furthest ahead


def test_near_is_the_nearest_point_unless_exact() -> None:
    visited = VisitedStates(2, SPACING)
    straight(visited, 5)
    for exact in (False, True):
        assert visited.near(np.array([2.2, 0.0]), 1.0, exact).tolist() == [2, 3]
    assert visited.near(np.array([9.0, 0.0]), 1.0).tolist() == [4]
    assert visited.near(np.array([9.0, 0.0]), 1.0, exact=True).tolist() == []


@pytest.mark.parametrize(("start", "goal"), [(0.0, 100.0), (-100.0, 4.0), (-100.0, 100.0), (-2.0, 0.0)])
def test_no_steps_between_places_that_no_trajectory_came_near(start: float, goal: float) -> None:
    visited = VisitedStates(2, SPACING)
    straight(visited, 5)
    assert visited.steps_between(np.array([start, 0.0]), np.array([goal, 0.0]), (0.5, 0.5)) == np.inf


@given(moves, points, st.sampled_from([0.6, 1.5]))
@profile(40)
def test_path_from_is_the_quickest_way_from_an_event(sequence: list[Move], point: np.ndarray, radius: float) -> None:
    visited = VisitedStates(2, SPACING, n_envs=3)
    oracle = record_all(visited, sequence)
    near = oracle.near(point, radius)
    for event in range(len(CENTERS)):
        way = visited.path_from(event, point, radius)
        quickest = oracle.events(point, radius, -1).get(event)
        assert way.shape == (len(way), 2)
        assert (len(way) > 0) == (quickest is not None)
        if quickest is not None:
            assert oracle.label(way[0]) == event
            assert all(oracle.label(p) < 0 for p in way[1:])
            ways = []
            for i in near:
                trajectory, step, _ = oracle.kept[i]
                if oracle.passed(i, -1) == (event, quickest):
                    ways.append([p for t, s, p in oracle.kept if t == trajectory and step - quickest <= s <= step])
            assert any(len(one) == len(way) and np.array_equal(np.stack(one), way) for one in ways)


@given(moves, st.integers(0, 12))
@profile(80)
def test_rewind_stops_within_reach_of_the_last_event(sequence: list[Move], max_steps: int) -> None:
    visited = VisitedStates(2, SPACING, n_envs=3)
    oracle = record_all(visited, sequence)
    for i, (trajectory, step, _) in enumerate(oracle.kept):
        at = visited.rewind(i, max_steps)
        assert oracle.kept[at][0] == trajectory
        assert oracle.kept[at][1] <= step
        passed = oracle.passed(i, -1)
        if passed is not None:
            behind = [(s, j) for j, (t, s, _) in enumerate(oracle.kept) if t == trajectory and s <= step]
            allowed = [(s, j) for s, j in behind if 0 <= s - (step - passed[1]) <= max_steps]
            assert at == max(allowed)[1]


@given(moves, moves, st.integers(0, 12))
@profile(80)
def test_rewind_does_not_depend_on_other_trajectories(first: list[Move], second: list[Move], max_steps: int) -> None:
    """Also where no event has been passed at all."""
    alone, later = VisitedStates(2, SPACING, n_envs=3), VisitedStates(2, SPACING, n_envs=3)
    record_all(alone, second, clock=100)
    record_all(later, first)
    later.cut(3)
    n = later.size
    record_all(later, second, clock=100)
    assert [later.rewind(n + i, max_steps) - n for i in range(alone.size)] == [
        alone.rewind(i, max_steps) for i in range(alone.size)
    ]


@given(st.lists(points, min_size=9, max_size=20))
@profile(30)
def test_labels_are_the_nearest_event_that_contains_the_point(asked: list[np.ndarray]) -> None:
    visited = VisitedStates(2, SPACING)
    visited.set_events(CENTERS, RADII)
    expected = [Oracle().label(point) for point in asked]
    assert visited.label(np.stack(asked)).tolist() == expected
    assert [int(visited.label(point[None])[0]) for point in asked] == expected


def test_no_event_no_label() -> None:
    visited = VisitedStates(2, SPACING)
    assert visited.label(np.zeros((1, 2))).tolist() == [-1]
    assert visited.label(np.zeros((20, 2))).tolist() == [-1] * 20


@given(moves)
@profile(30)
def test_events_set_later_label_what_was_visited_before(sequence: list[Move]) -> None:
    before, after = VisitedStates(2, SPACING, n_envs=3), VisitedStates(2, SPACING, n_envs=3)
    record_all(before, sequence)
    record_all(after, sequence, labelled=False)
    assert after.events_before(np.zeros(2), 3.0) == {}
    after.set_events(CENTERS, RADII)
    for point in np.array([[0.0, 0.0], [2.0, 2.0], [-3.0, 1.0]]):
        assert after.events_before(point, 1.0) == before.events_before(point, 1.0)


def test_nothing_visited() -> None:
    visited = VisitedStates(2, SPACING)
    assert visited.near(np.zeros(2), 5.0).size == 0
    assert visited.events_before(np.zeros(2), 5.0) == {}
    assert visited.events_after(np.zeros(2), 5.0) == {}
    assert visited.steps_between(np.zeros(2), np.ones(2), (5.0, 5.0)) == np.inf
    assert visited.waypoint(np.zeros(2), np.ones(2), (5.0, 5.0), 3) == -1


def straight(visited: VisitedStates, n: int, start: int = 0, y: float = 0.0) -> None:
    for t in range(n):
        visited.record(0, start + t, np.array([t, y], dtype=np.float32))


def test_the_older_half_is_forgotten_when_full() -> None:
    visited = VisitedStates(2, SPACING, capacity=10)
    visited.set_events(np.array([[0.0, 0.0], [8.0, 0.0]]), np.array([0.5, 0.5]))
    straight(visited, 14)
    assert visited.size <= 10
    assert visited.points[:, 0].tolist() == [5, 6, 7, 8, 9, 10, 11, 12, 13]
    assert visited.events_before(np.array([12.0, 0.0]), 0.1) == {1: 4}
    assert visited.events_before(np.array([6.0, 0.0]), 0.1) == {}  # the start of the trajectory has been forgotten


def test_many_points_outgrow_the_first_arrays() -> None:
    visited = VisitedStates(2, SPACING)
    straight(visited, 3000)
    assert visited.points[:, 0].tolist() == list(range(3000))


def test_events_that_count_as_none_are_looked_through() -> None:
    visited = VisitedStates(2, SPACING)
    visited.set_events(np.array([[0.0, 0.0], [4.0, 0.0]]), np.array([0.5, 0.5]))
    straight(visited, 8)
    point = np.array([6.0, 0.0])
    assert visited.events_before(point, 0.1) == {1: 2}
    assert visited.events_before(point, 0.1, (1,)) == {0: 6}
    assert visited.events_before(point, 0.1, (0, 1)) == {}
    assert visited.events_after(np.array([2.0, 0.0]), 0.1, (1,)) == {}
    assert visited.events_before(point, 0.1) == {1: 2}


def test_cut_ends_every_trajectory() -> None:
    visited = VisitedStates(2, SPACING)
    visited.set_events(np.array([[0.0, 0.0]]), np.array([0.5]))
    straight(visited, 5)
    visited.cut(2)
    visited.record(0, 5, np.array([5.0, 0.0], dtype=np.float32))
    visited.record(1, 6, np.array([6.0, 0.0], dtype=np.float32))
    assert visited.events_before(np.array([4.0, 0.0]), 0.1) == {0: 4}
    assert visited.events_before(np.array([5.0, 0.0]), 0.1) == {}
    assert visited.steps_between(np.array([5.0, 0.0]), np.array([6.0, 0.0]), (0.1, 0.1)) == np.inf


def test_the_end_of_an_episode_is_kept_however_near() -> None:
    visited = VisitedStates(2, SPACING)
    visited.record(0, 0, np.zeros(2, dtype=np.float32))
    visited.record(0, 1, np.full(2, 0.1, dtype=np.float32))
    visited.record(0, 2, np.full(2, 0.2, dtype=np.float32), done=True)
    visited.record(0, 3, np.full(2, 0.2, dtype=np.float32))
    np.testing.assert_allclose(visited.points[:, 0], [0.0, 0.2, 0.2])
    assert visited.steps_between(np.zeros(2), np.full(2, 0.2), (0.05, 0.05)) == 2


@pytest.mark.parametrize("n_first", [0, 25])
def test_state_round_trip(n_first: int) -> None:
    rng = np.random.default_rng(0)
    sequence = [(int(rng.integers(3)), *rng.integers(-3, 4, 2).tolist(), bool(rng.random() < 0.1)) for _ in range(60)]
    visited = VisitedStates(2, SPACING, n_envs=3, capacity=40)
    record_all(visited, sequence[:n_first])
    restored = VisitedStates(2, SPACING, n_envs=3, capacity=40)
    restored.set_state(copy.deepcopy(visited.get_state()))
    for memory in (visited, restored):
        record_all(memory, sequence[n_first:])
    np.testing.assert_array_equal(visited.points, restored.points)
    for i in range(visited.size):
        assert visited.rewind(i, 4) == restored.rewind(i, 4)
        assert visited.events_before(visited.points[i], 1.0) == restored.events_before(visited.points[i], 1.0)
        assert visited.events_after(visited.points[i], 1.0) == restored.events_after(visited.points[i], 1.0)
