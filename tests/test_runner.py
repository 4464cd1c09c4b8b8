"""Running options: how runs end, what is remembered of them within an episode, and where the next one begins."""

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_skillgraph.graph import SkillGraph
from sb3_skillgraph.planning import Planner
from sb3_skillgraph.runner import Runner
from sb3_skillgraph.running import MAX_RUNS, STILL_STEPS, Run, RunnerState
from sb3_skillgraph.walk_model import WalkModel, timeout

STEP = 0.5
HORIZON = 1_000


class Straight:
    """A policy that goes straight to its aim; what it sees is the way there."""

    def act(self, views: np.ndarray) -> np.ndarray:
        return np.clip(views, -1.0, 1.0)


def way_to_aim(observation: np.ndarray, points: np.ndarray, aims: np.ndarray) -> np.ndarray:
    return (aims - points) / STEP


def line_graph(n_events: int, spacing: float = 4.0) -> SkillGraph:
    graph = SkillGraph(2, 1.0, 1000)
    for i in range(n_events):
        graph.add_event(np.array([spacing * i, 0.0]), salient=False)
    return graph


def tried(graph: SkillGraph, source: int, target: int, successes: int) -> None:
    graph.crossed(source, target, 8)
    for _ in range(successes):
        graph.ran(source, target, True, target, 8)


def known_line(n_events: int = 4) -> SkillGraph:
    graph = line_graph(n_events)
    for i in range(n_events - 1):
        tried(graph, i, i + 1, 20)
        tried(graph, i + 1, i, 20)
    return graph


def model_of_short_walks() -> WalkModel:
    """Expects nothing of untried walks, except of the last step to a goal beside an event."""
    model = WalkModel()
    model.intercept, model.coefficients[1] = -4.0, -6.0
    return model


def make_runner(graph: SkillGraph) -> Runner:
    return Runner(graph, Planner(graph, model_of_short_walks(), HORIZON), Straight(), way_to_aim)  # type: ignore[arg-type]


def seen_at(points: np.ndarray) -> dict[str, np.ndarray]:
    return {"observation": points, "achieved_goal": points}


def free(before: np.ndarray, after: np.ndarray) -> bool:
    return True


class Trip:
    """One environment in which a point moves, and an agent that runs options in it."""

    def __init__(
        self,
        runner: Runner,
        start: tuple[float, float],
        goal: tuple[float, float],
        may_pass: Callable[[np.ndarray, np.ndarray], bool] = free,
    ) -> None:
        self.runner, self.may_pass = runner, may_pass
        self.point, self.goal = np.array([start]), np.array([goal])
        self.state = RunnerState.fresh(1, 2, 2)
        self.runs: list[Run] = []
        self.options: list[str] = []

    def step(self) -> None:
        self.state, runs = self.runner.advance(self.state, self.point)
        self.runs += runs
        action, self.state = self.runner.act(seen_at(self.point), self.goal, self.state)
        self.options.append(str(self.state.option[0]))
        after = self.point + STEP * action
        if self.may_pass(self.point[0], after[0]):
            self.point = after

    def arrived(self) -> bool:
        return bool(np.linalg.norm(self.point - self.goal) <= 1.0)

    def go(self, max_steps: int) -> int:
        for step in range(max_steps):
            if self.arrived():
                return step
            self.step()
        return max_steps


def running(
    option: str, *, began: str = "", aim: tuple[float, float] = (0.0, 0.0), steps: int = 1, may: int = 20
) -> RunnerState:
    fresh = RunnerState.fresh(1, 2, 2)
    ids = [np.array([id], dtype=fresh.option.dtype) for id in (option, began)]
    aims = np.array([aim], dtype=np.float32)
    return fresh._replace(
        option=ids[0], began=ids[1], aim=aims, steps=np.array([float(steps)]), timeout=np.array([float(may)])
    )


def record(state: RunnerState, i: int = 0) -> dict[tuple[str, str, str, bool], tuple[float, float]]:
    """The episode's runs: how many of each, and the steps they took."""
    kept = {}
    for slot in np.flatnonzero(state.run_option[i] != "").tolist():
        key = tuple(
            column[i, slot].item() for column in (state.run_event, state.run_option, state.run_landing, state.run_success)
        )
        assert key not in kept
        kept[key] = float(state.run_count[i, slot]), float(state.run_steps[i, slot])
    return kept


# -- how runs end -----------------------------------------------------------------------------------------------------


def test_a_run_ends_on_arrival_and_the_next_begins_in_the_event_arrived_at() -> None:
    runner = make_runner(known_line())
    # Within the radius of e1, but nearer to the middle between it and e2.
    state, runs = runner.advance(running("w1", began="e0", aim=(4.0, 0.0), steps=7), np.array([[4.9, 0.3]]))
    assert [(run.event, run.option, run.landing, run.success, run.steps) for run in runs] == [("e0", "w1", "e1", True, 7)]
    assert (state.option[0], state.arrived[0]) == ("", "e1")
    _, state = runner.act(seen_at(np.array([[4.9, 0.3]])), np.array([[12.0, 0.0]]), state)
    assert (state.option[0], state.began[0]) == ("w2", "e1")


def test_the_event_arrived_at_counts_even_where_another_one_is_nearer() -> None:
    graph = line_graph(3, spacing=1.6)
    runner = make_runner(graph)
    point = np.array([0.9, 0.0])
    assert graph.locate(point) == 1
    state, _ = runner.advance(running("w0", aim=(0.0, 0.0)), point[None])
    assert runner.start(state, 0, point).event == 0
    failed, _ = runner.advance(running("w2", began="e0", aim=(3.2, 0.0), steps=20), point[None])
    assert runner.start(failed, 0, point).event == 1


def test_a_run_goes_on_until_it_arrives_or_its_time_is_up() -> None:
    runner = make_runner(known_line())
    away, going = np.array([[1.9, 0.0]]), running("w1", began="e0", aim=(4.0, 0.0), steps=19)
    state, runs = runner.advance(going, away)
    assert not runs
    assert state is going
    state, runs = runner.advance(going._replace(steps=np.array([20.0])), away)
    assert [(run.option, run.landing, run.success, run.steps) for run in runs] == [("w1", "", False, 20)]
    assert (state.option[0], state.arrived[0]) == ("", "")


def test_a_run_that_fails_lands_in_the_event_it_ends_in() -> None:
    runner = make_runner(known_line())
    state, runs = runner.advance(running("w3", began="e1", aim=(12.0, 0.0), steps=20), np.array([[8.5, 0.0]]))
    assert (runs[0].landing, runs[0].success) == ("e2", False)
    assert state.arrived[0] == ""  # nobody meant to go there


def test_a_run_ends_where_the_agent_is_stuck_and_lands_nowhere() -> None:
    runner = make_runner(known_line())
    point = np.array([[4.0, 0.0]])
    _, runs = runner.advance(running("w1", began="e0", aim=(4.0, 0.0), steps=3), point, [True])
    assert [(run.landing, run.success) for run in runs] == [("", False)]
    _, runs = runner.advance(running("w1", began="e0", aim=(4.0, 0.0), steps=3), point, [False])
    assert [(run.landing, run.success) for run in runs] == [("e1", True)]


def test_a_walk_to_the_goal_lands_in_the_goal() -> None:
    runner = make_runner(known_line())
    state, runs = runner.advance(running("direct", began="e0", aim=(2.0, 0.0), steps=4), np.array([[2.5, 0.0]]))
    assert [(run.landing, run.success, run.aim.tolist()) for run in runs] == [("goal", True, [2.0, 0.0])]
    assert (state.arrived[0], state.steps[0]) == ("goal", 0)
    assert not state.failed[0]
    assert runner.start(state, 0, np.array([4.0, 0.0])).event == 1, "where it stands"


class Back:
    """A policy that does the opposite of the first."""

    def act(self, seen: np.ndarray) -> np.ndarray:
        return -np.asarray(Straight().act(seen))


def test_the_second_policy_has_the_run_after_a_failed_one_and_no_other() -> None:
    runner = make_runner(known_line())
    runner.second = Back()  # type: ignore[assignment]
    goal, at = np.array([[12.0, 0.0]]), np.array([[4.0, 0.0]])

    def heading(state: RunnerState) -> float:
        return float(runner.act(seen_at(at), goal, state)[0][0, 0])

    fresh = RunnerState.fresh(1, 2, 2)
    assert heading(fresh) > 0
    failed, _ = runner.advance(running("w2", began="e1", aim=(8.0, 0.0), steps=20), at)
    assert heading(failed) < 0
    _, still_running = runner.act(seen_at(at), goal, failed)
    assert heading(still_running) < 0  # to its end
    arrived, _ = runner.advance(running("w1", began="e0", aim=(4.0, 0.0), steps=20), at)
    assert heading(arrived) > 0
    runner.second = None
    assert heading(failed) > 0


def test_each_environment_has_the_policy_that_its_own_last_run_asks_for() -> None:
    runner = make_runner(known_line())
    runner.second = Back()  # type: ignore[assignment]
    points, goals = np.array([[4.0, 0.0]] * 2), np.array([[12.0, 0.0]] * 2)
    fresh = RunnerState.fresh(2, 2, 2)
    of_first = np.array([True, False])
    state = fresh._replace(
        option=np.where(of_first, "w2", fresh.option), aim=np.array([[8.0, 0.0], [0.0, 0.0]], dtype=np.float32)
    )
    state, runs = runner.advance(state, points)
    assert [run.env for run in runs] == [0]
    actions, _ = runner.act(seen_at(points), goals, state)
    assert (actions[:, 0] < 0).tolist() == [True, False]


def test_where_nothing_runs_nothing_ends() -> None:
    runner = make_runner(known_line())
    state = RunnerState.fresh(3, 2, 2)
    after, runs = runner.advance(state, np.zeros((3, 2)), [True] * 3)
    assert after is state
    assert runs == []


def test_a_run_may_take_the_time_that_its_expected_steps_allow() -> None:
    graph = known_line()
    runner = make_runner(graph)
    _, state = runner.act(seen_at(np.zeros((1, 2))), np.array([[12.0, 0.0]]), RunnerState.fresh(1, 2, 2))
    walks = runner.planner.choice_model.walks()
    assert state.option[0] == "w1"
    assert state.timeout[0] == pytest.approx(timeout(float(walks.steps[graph.edges.find(0, 1)])))
    assert (state.steps[0], state.elapsed[0]) == (1, 1)
    np.testing.assert_array_equal(state.aim, [[4.0, 0.0]])


def test_who_stands_still_has_failed_long_before_the_time_is_up() -> None:
    trip = Trip(make_runner(known_line()), (0.0, 0.0), (12.0, 0.0), wall_at(2.0))
    while not trip.runs:
        trip.step()
    (run,) = trip.runs
    assert (run.option, run.success, run.landing) == ("w1", False, "e0")
    assert run.steps <= 4 + STILL_STEPS + 2  # on the way to the wall, standing before it
    assert trip.state.run_steps.sum() == run.steps
    # The next option has as much time, although the agent still stands.
    while len(trip.runs) < 2:
        trip.step()
    assert STILL_STEPS <= trip.runs[1].steps <= STILL_STEPS + 3


def test_who_moves_slowly_does_not_stand_still() -> None:
    runner = make_runner(known_line())
    trip = Trip(runner, (0.0, 0.0), (4.0, 0.0))
    trip.step()
    for k in range(3 * STILL_STEPS):
        trip.point = np.array([[0.5 + 0.01 * k, 0.0]])  # a fiftieth of its largest step
        trip.step()
        assert trip.state.still[0] == 0
        assert not trip.runs


def test_each_environment_stands_still_for_itself() -> None:
    runner = make_runner(known_line())
    state = RunnerState.fresh(2, 2, 2)
    for k in range(2 * STILL_STEPS):
        points = np.array([[0.0, 0.0], [0.1 * min(k, 9), 0.0]])
        _, state = runner.act(seen_at(points), np.full((2, 2), [12.0, 0.0]), state)
        assert state.still.tolist() == [k, max(k - 9, 0)]
    assert state.pace[0].tolist() == [0.0] * 4
    assert state.pace[1, 0] == pytest.approx(0.1, rel=0.1)


def moving(seen: list[list[float]], points: list[list[float]]) -> RunnerState:
    """The state of an agent that has seen and been what it is told, under one option."""
    runner, state = make_runner(known_line()), RunnerState.fresh(1, 2, len(seen[0]))
    for observation, point in zip(seen, points, strict=True):
        at = {"observation": np.array([observation]), "achieved_goal": np.array([point])}
        _, state = runner.act(at, np.array([[12.0, 0.0]]), state)
    return state


def test_a_jump_is_no_pace_beside_which_walking_is_standing() -> None:
    points = [[0.2 * k, 0.0] for k in range(10)] + [[60.0 + 0.2 * k, 0.0] for k in range(20)]
    assert moving(points, points).still[0] == 0


def test_who_moves_without_seeing_it_does_not_stand_still() -> None:
    points = [[0.2 * k, 0.0] for k in range(20)]
    assert moving([[0.5]] * 20, points).still[0] == 0  # at a constant speed
    assert moving([[]] * 20, points).still[0] == 0
    assert moving([[0.5]] * 20, [[0.2 * min(k, 5), 0.0] for k in range(20)]).still[0] == 14


def test_large_entries_do_not_hide_small_ones() -> None:
    seen = [[1e6 * (k % 2), 0.0] for k in range(6)] + [[0.0, 1e-3 * k] for k in range(20)]
    assert moving(seen, [[0.0, 0.0]] * 26).still[0] == 0


def test_how_an_agent_moves_is_known_when_it_has_something_else_to_do() -> None:
    points = [[0.2 * k, 0.0] for k in range(5)]
    state = moving(points, points)
    for same_episode in (True, False):
        anew = state.begun_anew(np.ones(1, dtype=bool), same_episode=same_episode)
        assert (anew.option[0], anew.still[0], anew.run_count.sum()) == ("", 0, 0)
        assert bool(anew.pace.any()) is same_episode
        assert anew.elapsed[0] == (5 if same_episode else 0)


def test_a_run_to_an_event_that_is_merged_away_meanwhile_ends_like_others() -> None:
    graph = line_graph(4, spacing=1.6)
    runner = make_runner(graph)
    state = running("w1", began="e0", aim=(1.6, 0.0), steps=3)
    graph.coarsen()
    assert graph.index("w1") == -1
    state, runs = runner.advance(state, np.array([[1.6, 0.0]]))
    assert [(run.success, run.landing) for run in runs] == [(True, "")]
    runner.act(seen_at(np.array([[1.6, 0.0]])), np.array([[3.2, 0.0]]), state)
    assert len(runner.runs(state, 0).source) == 0  # nothing can be concluded from it


def test_a_plan_begins_in_the_event_where_the_running_option_began_and_goes_towards_its_target() -> None:
    runner = make_runner(known_line())
    point = np.array([5.0, 0.0])
    for option, began, expected in (("w3", "e0", (0, 3)), ("direct", "e0", (0, 4)), ("w3", "", (-1, 3)), ("", "", (1, -1))):
        start = runner.start(running(option, began=began), 0, point)
        np.testing.assert_array_equal(start.point, point)
        assert (start.event, start.towards) == expected


# -- a whole way ------------------------------------------------------------------------------------------------------


def test_an_agent_goes_from_event_to_event_and_counts_its_runs() -> None:
    trip = Trip(make_runner(known_line()), (0.0, 0.0), (12.0, 0.0))
    steps = trip.go(60)
    assert trip.arrived()
    assert steps == 22  # eleven units of way in steps of half a unit
    assert list(dict.fromkeys(trip.options)) == ["w1", "w2", "direct"]
    assert [(run.event, run.option, run.landing) for run in trip.runs] == [("e0", "w1", "e1"), ("e1", "w2", "e2")]
    kept = record(trip.state)
    assert kept == {("e0", "w1", "e1", True): (1.0, 6.0), ("e1", "w2", "e2", True): (1.0, 8.0)}
    assert trip.state.elapsed[0] == steps == 6 + 8 + trip.state.steps[0]


def wall_at(x: float) -> Callable[[np.ndarray, np.ndarray], bool]:
    """A wall across the first axis, which can be gone around."""

    def may_pass(before: np.ndarray, after: np.ndarray) -> bool:
        return abs(before[1]) > 2.0 or (before[0] - x) * (after[0] - x) > 0.0

    return may_pass


def test_a_walk_that_keeps_failing_in_an_episode_gives_way_to_another() -> None:
    graph = SkillGraph(2, 1.0, 100)
    for place in ((0.0, 0.0), (4.0, 0.0), (0.0, 4.0), (4.0, 4.0), (8.0, 0.0)):
        graph.add_event(np.array(place), salient=False)
    for source, target in ((0, 1), (1, 4), (0, 2), (2, 3), (3, 1)):
        tried(graph, source, target, 20)  # all of them good roads, in training
    trip = Trip(make_runner(graph), (0.0, 0.0), (8.0, 0.0), wall_at(2.0))
    trip.step()
    assert trip.options == ["w1"]
    trip.go(1_000)
    assert trip.arrived()
    failures = [run for run in trip.runs if not run.success]
    assert 1 <= len(failures) <= 12
    assert {run.option for run in failures} == {"w1"}
    assert [run.option for run in trip.runs if run.success][:3] == ["w2", "w3", "w1"]
    kept = record(trip.state)
    assert sum(count for count, _ in kept.values()) == len(trip.runs)
    assert kept["e0", "w1", failures[0].landing, False][0] >= 1.0


def test_where_no_way_is_known_it_goes_where_it_is_worth_most_to_walk_straight_on() -> None:
    graph = known_line(8)
    for place in ((30.0, 2.0), (34.0, 2.0)):  # an island, with the goal
        graph.add_event(np.array(place), salient=False)
    tried(graph, 8, 9, 20)
    model = WalkModel()
    model.intercept, model.coefficients[5:] = 3.0, (0.0, -2.0)  # of walks that nobody was seen to do, long ones seldom succeed
    runner = Runner(graph, Planner(graph, model, HORIZON), Straight(), way_to_aim)  # type: ignore[arg-type]
    trip = Trip(runner, (0.0, 0.0), (34.0, 2.0))
    trip.step()
    assert trip.options == ["w1"]
    trip.go(HORIZON)
    assert trip.arrived()
    (last,) = [run for run in trip.runs if run.option == "direct"] or [trip.runs[-1]]
    assert last.event in ("e6", "e7")


def test_a_gamble_that_does_not_come_off_is_not_repeated_for_ever() -> None:
    graph = SkillGraph(2, 1.0, 100)
    for place in ((0.0, 0.0), (20.0, 0.0), *((5.0 * k, 6.0) for k in range(5))):
        graph.add_event(np.array(place), salient=False)
    graph.crossed(0, 1, 8)
    for _ in range(10):  # in training it came off more often than not
        graph.ran(0, 1, True, 1, 8)
    for _ in range(4):
        graph.ran(0, 1, False, 0, 30)
    road = (0, 2, 3, 4, 5, 6, 1)
    for source, target in pairwise(road):
        tried(graph, source, target, 20)
    runner = make_runner(graph)

    def no_gamble(before: np.ndarray, after: np.ndarray) -> bool:
        return before[1] > 3.0 or after[1] > before[1] or before[0] > 15.0

    trip = Trip(runner, (0.0, 0.0), (20.0, 0.0), no_gamble)
    trip.go(2_000)
    assert trip.arrived()
    assert trip.options[0] in ("w1", "direct")
    assert sum(not run.success for run in trip.runs) < 20
    assert {"w2", "w3", "w4"} <= set(trip.options)


def test_successes_count_in_an_episode_as_failures_do() -> None:
    graph = known_line()
    runner = make_runner(graph)
    state = RunnerState.fresh(1, 2, 2)
    rates = []
    for _ in range(3):
        start = runner.start(state, 0, np.array([8.0, 0.0]))
        solution = runner.decide(state, 0, start, np.array([12.0, 0.0]), 0.0)
        choices = solution.choices
        row = np.flatnonzero((choices.source == 1) & (choices.target == 2))[-1]
        rates.append(float(choices.success(0.0)[row]))
        going = running("w2", began="e1", aim=(8.0, 0.0), steps=9)
        state, _ = runner.advance(going._replace(**{name: getattr(state, name) for name in _EPISODE}), np.array([[8.0, 0.0]]))
    assert rates == sorted(set(rates))


_EPISODE = ("elapsed", "run_event", "run_option", "run_landing", "run_success", "run_steps", "run_count")

# -- the record of the episode ----------------------------------------------------------------------------------------


def end_runs(runner: Runner, state: RunnerState, ends: list[tuple[str, str, tuple[float, float], int]]) -> RunnerState:
    """Let options end one after the other: where they began, which they were, where they end, and after how many steps."""
    for began, option, point, steps in ends:
        aim = (0.0, 99.0) if option == "direct" else tuple(runner.graph.events[runner.graph.index(option)].center)
        going = running(option, began=began, aim=aim, steps=steps, may=0)
        state, ended = runner.advance(going._replace(**{name: getattr(state, name) for name in _EPISODE}), np.array([point]))
        assert len(ended) == 1
    return state


def test_runs_of_one_kind_are_counted_and_others_told_apart() -> None:
    runner = make_runner(known_line())
    ends = [("e0", "w1", (0.0, 0.0), 5), ("e0", "w1", (0.0, 0.0), 7), ("e0", "w1", (4.0, 0.0), 3), ("", "w1", (0.0, 0.0), 2)]
    state = end_runs(runner, RunnerState.fresh(1, 2, 2), ends)
    assert record(state) == {
        ("e0", "w1", "e0", False): (2.0, 12.0),
        ("e0", "w1", "e1", True): (1.0, 3.0),
        ("", "w1", "e0", False): (1.0, 2.0),
    }
    planned = runner.runs(state, 0)
    rows = sorted(zip(*(column.tolist() for column in planned), strict=True))
    assert rows == [(-1, 1, 0, 0, 1), (0, 1, 0, 0, 2), (0, 1, 1, 1, 1)]


def test_a_walk_to_the_goal_is_counted_too() -> None:
    runner = make_runner(known_line())
    state = end_runs(runner, RunnerState.fresh(1, 2, 2), [("e2", "direct", (0.0, 0.0), 9)] * 3)
    assert record(state) == {("e2", "direct", "e0", False): (3.0, 27.0)}
    assert [column.tolist() for column in runner.runs(state, 0)] == [[2], [4], [0], [0], [3]]


def test_no_run_is_lost_when_there_are_more_kinds_than_are_told_apart() -> None:
    graph = known_line(24)
    runner = make_runner(graph)
    rng = np.random.default_rng(0)
    state, total, steps = RunnerState.fresh(1, 2, 2), 0, 0
    for k in range(400):
        source, target = divmod(k, 20)
        at = graph.centers[rng.integers(24)]
        taken = int(rng.integers(1, 30))
        end = (float(at[0]), float(at[1]))
        state = end_runs(runner, state, [(f"e{source}", "direct" if k % 20 == 0 else f"w{target}", end, taken)])
        total, steps = total + 1, steps + taken
        assert state.run_count.sum() == total
        assert state.run_steps.sum() == steps
    assert (state.run_option[0] != "").sum() == MAX_RUNS
    assert runner.runs(state, 0).number.sum() == total
    # The merged runs are still of their own option, where that one is told apart at all.
    before = runner.runs(state, 0)
    after = runner.runs(end_runs(runner, state, [("e3", "w5", (60.0, 0.0), 9)] * 7), 0)
    assert (after.number - before.number)[before.target == 5].sum() == 7


def test_a_state_is_never_changed_in_place() -> None:
    runner = make_runner(known_line())
    state = running("w1", began="e0", aim=(4.0, 0.0), steps=9)
    kept = state.copy()
    ended, runs = runner.advance(state, np.array([[4.0, 0.0]]))
    assert runs
    np.testing.assert_equal(tuple(state), tuple(kept))
    kept = ended.copy()
    runner.act(seen_at(np.array([[4.0, 0.0]])), np.array([[12.0, 0.0]]), ended)
    np.testing.assert_equal(tuple(ended), tuple(kept))


def test_a_new_episode_begins_anew_in_its_environment_only() -> None:
    runner = make_runner(known_line())
    points = np.array([[0.0, 0.0], [4.0, 0.0]])
    state = RunnerState.fresh(2, 2, 2)
    for _ in range(9):
        state, _ = runner.advance(state, points)
        _, state = runner.act(seen_at(points), np.array([[12.0, 0.0], [0.0, 0.0]]), state)
        points = points + 0.5
    state, runs = runner.advance(state._replace(timeout=np.zeros(2)), points)
    assert len(runs) == 2
    anew = state.begun_anew(np.array([True, False]))
    for name, column in anew._asdict().items():
        np.testing.assert_array_equal(column[0], getattr(RunnerState.fresh(1, 2, 2), name)[0], err_msg=name)
        np.testing.assert_array_equal(column[1], getattr(state, name)[1], err_msg=name)
        assert column.dtype == getattr(state, name).dtype


# -- several environments ---------------------------------------------------------------------------------------------


def of_env(state: RunnerState, i: int) -> RunnerState:
    return RunnerState(*(column[i : i + 1] for column in state))


@settings(derandomize=True, deadline=None, max_examples=15, database=None)
@given(st.integers(0, 10_000), st.integers(2, 4))
def test_several_environments_act_as_each_would_alone(seed: int, n_envs: int) -> None:
    rng = np.random.default_rng(seed)
    graph = known_line(6)
    points, goals = rng.uniform((-3.0, -2.0), (23.0, 2.0), (2, n_envs, 2))
    slips = rng.normal(0.0, 0.4, (25, n_envs, 2))
    together = RunnerState.fresh(n_envs, 2, 2)
    runner, alone = make_runner(graph), [make_runner(graph) for _ in range(n_envs)]
    states = [RunnerState.fresh(1, 2, 2) for _ in range(n_envs)]
    for slip in slips:
        together, runs = runner.advance(together, points)
        actions, together = runner.act(seen_at(points), goals, together)
        for i in range(n_envs):
            states[i], mine = alone[i].advance(states[i], points[i : i + 1])
            assert [_plain(run) for run in mine] == [_plain(run) for run in runs if run.env == i]
            action, states[i] = alone[i].act(seen_at(points[i : i + 1]), goals[i : i + 1], states[i])
            np.testing.assert_array_equal(action[0], actions[i])
            np.testing.assert_equal(tuple(states[i]), tuple(of_env(together, i)))
        points = points + STEP * actions + slip


def _plain(run: Run) -> dict[str, Any]:
    fields = {name: value for name, value in vars(run).items() if name != "env"}
    return {**fields, "aim": run.aim.tolist()}
