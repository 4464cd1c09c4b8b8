"""Options chosen and run on hand-built graphs, one step at a time (sections 3.2.4, 3.2.5)."""

from collections.abc import Collection

import numpy as np
import pytest
from builders import World

from sb3_skillgraph.controller import (
    FAILED,
    GLOBAL,
    MANY_DECISIONS,
    SHAKE,
    UNDECIDED,
    Controller,
    ControllerState,
    Request,
)

O1, O2, O3, O4 = 1, 2, 3, 4


def at(*xs: float) -> np.ndarray:
    """Points on the line, shape ``(n, 2)``."""
    return np.stack([np.array(xs), np.zeros(len(xs))], axis=1)


def observe(points: np.ndarray) -> dict[str, np.ndarray]:
    return {"observation": points.astype(np.float32), "achieved_goal": points.astype(np.float32)}


def to_event(world: World, id: str) -> Request:
    return Request(world.graph.events[id].center, event=id)


@pytest.fixture
def line() -> World:
    world = World()
    world.line()
    return world


def choose(world: World, x: float, request: Request, failures: int = 0, failed: Collection[int] = ()) -> tuple[int, int]:
    return world.controller.choose(at(x)[0], request, failures, failed)


def waypoint(world: World, aim: int) -> np.ndarray:
    """The visited point that an aim of -2 and less stands for."""
    assert -2 - 2 * world.visited.size < aim <= -2
    return world.visited.points[(-2 - aim) // 2].astype(np.float64)


def retrace(world: World, start: np.ndarray, request: Request, failures: int = 0) -> tuple[np.ndarray, int]:
    """The waypoints of a walk by the global option that reaches each of them, and where it aims at last."""
    ways, point = [], start
    for _ in range(100):
        index, aim = world.controller.choose(point, request, failures, ())
        assert index == GLOBAL
        if aim > -2:
            return np.array(ways).reshape(-1, 2), aim
        point = waypoint(world, aim)
        ways.append(point)
    raise AssertionError(f"walks for ever: {ways[-4:]}")


def state(n_envs: int = 1, **fields: list[int]) -> ControllerState:
    return ControllerState.fresh(n_envs)._replace(**{name: np.array(value) for name, value in fields.items()})


def test_a_fresh_state_is_undecided() -> None:
    fresh = ControllerState.fresh(3)
    assert all(array.shape == (3,) for array in fresh)
    assert fresh.option.tolist() == [UNDECIDED] * 3
    assert fresh.failures.tolist() == fresh.steps.tolist() == fresh.decisions.tolist() == [0] * 3
    assert fresh.failed_last.tolist() == fresh.failed_before.tolist() == fresh.aim.tolist() == [-1] * 3
    copied = fresh.copy()
    assert not any(np.shares_memory(a, b) for a, b in zip(copied, fresh, strict=True))
    assert len({array.__array_interface__["data"][0] for array in fresh}) == len(fresh) == 9


# -- choosing ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("x", "target", "option"),
    [
        (0, "e2", O1),
        (0, "e1", O1),
        (10, "e2", O2),
        (20, "e0", O3),
        (10, "e0", O4),
        (12, "e2", O2),
    ],
)
def test_the_first_option_of_the_plan_is_chosen(line: World, x: float, target: str, option: int) -> None:
    assert choose(line, x, to_event(line, target)) == (option, -1)


def test_no_option_is_chosen_from_outside_its_initiation_set(line: World) -> None:
    for x in np.linspace(-5, 25, 61):
        for target in line.graph.events:
            for request in (to_event(line, target), Request(line.graph.events[target].center)):
                index, aim = choose(line, x, request)
                assert index == GLOBAL or line.controller.option(index).initiation.optimistic(at(x))[0]
                assert aim == -1 or index == GLOBAL


def test_outside_the_graph_the_agent_walks_to_where_it_can_be_entered(line: World) -> None:
    xs = [5.0]
    while (option := choose(line, xs[-1], to_event(line, "e2")))[0] == GLOBAL:
        assert option[1] in (0, 1) or option[1] <= -2
        to = waypoint(line, option[1]) if option[1] <= -2 else line.controller.event(option[1]).center
        assert to[1] == 0.0
        xs.append(to[0])
    assert option in ((O1, -1), (O2, -1))
    assert len(xs) > 1
    assert (np.diff(xs) > 0).all() or (np.diff(xs) < 0).all()  # nearer with every waypoint
    for id in ("o1", "o2", "o3", "o4"):
        line.graph.remove_options([id])
    points, aim = retrace(line, at(5.0)[0], to_event(line, "e2"))
    assert aim == 2  # to the event itself, where nothing leads on
    assert len(points) >= 2
    assert (np.diff(points[:, 0]) > 0).all()
    blind = World()
    blind.add_event(20.0, 0.0)
    assert choose(blind, 5.0, to_event(blind, "e0")) == (GLOBAL, 0)  # straight: nobody has been there


def test_direct_requests_and_an_agent_that_does_not_plan_walk_straight(line: World) -> None:
    assert choose(line, 0.0, Request(at(20.0)[0], direct=True)) == (GLOBAL, -1)
    assert choose(line, 0.0, Request(at(20.0)[0])) == (O1, -1)
    line.controller.planning = False
    assert choose(line, 0.0, Request(at(20.0)[0])) == (GLOBAL, -1)
    assert choose(line, 0.0, to_event(line, "e2")) == (GLOBAL, -1)


def test_a_detour_around_the_option_that_has_just_failed(line: World) -> None:
    detour = line.add_option(line.graph.events["e1"], (0.0, 0.0), failures=5)
    for request in (to_event(line, "e2"), Request(at(20.0)[0])):
        assert choose(line, 0.0, request) == (O1, -1)
        assert choose(line, 0.0, request, failed=[O1]) == (line.controller.index(detour), -1)
        assert choose(line, 0.0, request, failed=[GLOBAL, -1]) == (O1, -1)
    assert choose(line, 10.0, to_event(line, "e2"), failed=[O1]) == (O2, -1)
    assert choose(line, 0.0, to_event(line, "e2"), failed=[O1, line.controller.index(detour)]) == (O1, -1)  # no other way


def test_a_detour_around_an_option_that_failed_further_on(line: World) -> None:
    """Not only the option to begin with: none that has failed lately is in the plan if there is another way."""
    straight = line.add_option(line.graph.events["e2"], (0.0, 0.0), failures=7)  # dearer than o1 and o2 together
    for request in (to_event(line, "e2"), Request(at(20.0)[0])):
        assert choose(line, 0.0, request) == (O1, -1)
        assert choose(line, 0.0, request, failed=[O1]) == (line.controller.index(straight), -1)
        assert choose(line, 0.0, request, failed=[O2]) == (line.controller.index(straight), -1)
        assert choose(line, 0.0, request, failed=[O3, O4]) == (O1, -1)


def test_a_goal_no_other_option_leads_to_is_walked_to_along_the_known_way(line: World) -> None:
    option, aim = choose(line, 0.0, Request(at(20.0)[0]), failed=[O2])
    assert option == GLOBAL
    assert 0.0 < waypoint(line, aim)[0] < 20.0


def test_after_a_failed_approach_the_next_leg(line: World) -> None:
    line.add_option(line.graph.events["e2"], (0.0, 0.0), failures=5)  # straight to e2, but dear
    goal = Request(at(14.0)[0])
    legs = line.planner.legs(at(0.0)[0], goal.goal)
    assert len({leg.path.vertices[0] for leg in legs if leg.path is not None}) >= 2
    assert any(leg.path is None for leg in legs)  # the way walked before, from end to end
    for failures, leg in enumerate([*legs, "retrace", "straight", *legs]):
        option, aim = choose(line, 0.0, goal, failures)
        if leg == "straight":
            assert (option, aim) == (GLOBAL, -1), "after all legs straight on, and then from the first again"
        elif leg == "retrace" or leg.path is None:
            assert option == GLOBAL
            assert 0.0 < waypoint(line, aim)[0] < 14.0
        else:
            assert (option, aim) == (int(leg.path.vertices[0][1:]), -1)


def test_a_failed_approach_leads_to_another_event() -> None:
    """Two events from which the goal has been reached, each with its option from the start."""
    world = World()
    start, near, far = world.add_event(0.0, 0.0), world.add_event(10.0, 0.0), world.add_event(0.0, 10.0)
    first, second = world.add_option(near, (0.0, 0.0)), world.add_option(far, (0.0, 0.0))
    world.walk((0, 0), (0, 0), 1)
    world.walk((10, 0), (10, 10), 20)
    world.walk((0, 10), (10, 10), 35)
    goal = Request(np.array([10.0, 10.0]))
    chosen = [world.controller.choose(start.center, goal, failures, ())[0] for failures in range(3)]
    assert chosen == [world.controller.index(first), world.controller.index(second), GLOBAL]


def test_only_after_a_failure_another_way_is_tried(line: World) -> None:
    line.add_option(line.graph.events["e2"], (0.0, 0.0), failures=5)  # straight to e2, but dear
    goal = Request(at(14.0)[0])
    first, second = (leg.path for leg in line.planner.legs(at(0.0)[0], goal.goal)[:2])
    for before, path in ((FAILED, second), (UNDECIDED, first)):
        _, _, running = line.controller.act(observe(at(0.0)), state(option=[before], failures=[1]), [goal])
        assert running.option.tolist() == [GLOBAL if path is None else int(path.vertices[0][1:])]
        assert running.failures.tolist() == [1]


def test_practice_plans_to_the_chains_source_and_then_follows_the_chain(line: World) -> None:
    chain = line.chaining.open_chain(line.graph.events["e1"], line.graph.events["e2"])
    root = line.chaining.options[chain.options[0]]
    request = Request(at(20.0)[0], event="e2", chain=chain.id)
    assert choose(line, 0.0, request) == (O1, -1)
    assert choose(line, 10.0, request) == (line.controller.index(root), -1)
    assert choose(line, 0.0, request._replace(left_graph=True)) == (line.controller.index(root), -1)


# -- known ways -------------------------------------------------------------------------------------------------------


@pytest.fixture
def corner() -> World:
    """A corridor around a corner, walked once: right, then up."""
    world = World(reach=30)
    world.tour([(0, 0), (10, 0), (10, 10)], 20)
    return world


@pytest.mark.parametrize("failures", [0, 4, 6])
@pytest.mark.parametrize("start", [(0.0, 0.0), (0.2, -0.3), (4.1, 0.2), (0.0, -3.0)])
def test_the_global_option_retraces_a_known_way_around_a_corner(
    corner: World, start: tuple[float, float], failures: int
) -> None:
    goal = np.array([10.0, 9.0])
    points, aim = retrace(corner, np.array(start), Request(goal), failures)
    assert aim == -1  # at last the goal itself
    on_first, on_second = points[:, 1] == 0.0, points[:, 0] == 10.0
    assert (on_first | on_second).all()  # never across the corner
    assert on_first.any()
    assert on_second.any()
    passed = points.sum(axis=1)  # what lies behind, in goal units
    stretches = np.diff([max(start[0], 0.0), *passed, 19.0])
    assert (stretches > 0).all()
    assert stretches.max() <= (corner.planner.reach // (6 if failures else 3)) * 0.5 + 1.0


def test_stretches_are_shorter_after_a_failure(corner: World) -> None:
    n_waypoints = [len(retrace(corner, np.zeros(2), Request(np.array([10.0, 9.0])), n)[0]) for n in (0, 1)]
    assert n_waypoints[1] > n_waypoints[0] > 2


def test_every_third_approach_is_straight_where_there_is_no_plan(corner: World) -> None:
    straight = [choose(corner, 0.0, Request(np.array([10.0, 9.0])), failures) == (GLOBAL, -1) for failures in range(6)]
    assert straight == [False, False, True] * 2


def test_a_way_back_nobody_has_gone_is_the_way_that_came(corner: World) -> None:
    points, aim = retrace(corner, np.array([10.0, 10.0]), Request(np.zeros(2)), 0)
    assert aim == -1
    assert ((points[:, 1] == 0.0) | (points[:, 0] == 10.0)).all()
    assert (np.diff([20.0, *points.sum(axis=1), 0.0]) < 0).all()
    assert len(points) > 2


def test_nobody_having_come_near_the_goal_the_way_that_came_nearest_is_tried_too(corner: World) -> None:
    """Nothing leads there: the global option retraces the way to the nearest point visited, goes straight, and anew."""
    goal = np.array([10.0, 16.0])
    for failures, straight in enumerate([False, True] * 2):
        option, aim = choose(corner, 0.0, Request(goal), failures)
        assert option == GLOBAL
        assert (aim == -1) == straight
        assert straight or waypoint(corner, aim)[1] == 0.0


def test_by_euclidean_nearness_the_global_option_walks_straight() -> None:
    """The paper's agent knows no ways but those of the graph."""
    world = World(nearest="euclidean")
    world.tour([(0, 0), (10, 0), (10, 10)], 20)
    assert choose(world, 0.0, Request(np.array([10.0, 9.0]))) == (GLOBAL, -1)


def test_a_retraced_way_is_walked_waypoint_by_waypoint(corner: World) -> None:
    controller, request = corner.controller, [Request(np.array([10.0, 9.0]))]
    running, point, ends = ControllerState.fresh(1), np.zeros((1, 2)), []
    for _ in range(60):
        _, aims, running = controller.act(observe(point), running, request)
        assert running.option.tolist() == [GLOBAL]
        way = aims - point
        point = point + way * min(1.0, 2.0 / max(float(np.linalg.norm(way)), 1e-9))  # two units a step, straight
        running, outcomes = controller.advance(running, point, request)
        ends += [(outcome.success, outcome.aim) for outcome in outcomes]
        if ends and ends[-1][1] == -1:
            break
    assert all(success for success, _ in ends)
    assert ends[-1][1] == -1
    assert len({aim for _, aim in ends}) == len(ends) > 2
    assert running.failures.tolist() == [0]


def test_a_way_once_begun_is_walked_to_its_end(line: World) -> None:
    """Where a plan over the graph would be cheaper, a walker that has just reached a waypoint goes on all the same."""
    goal = Request(at(20.0)[0])
    for last_aim, goes_on in ((-2, True), (-12, True), (-1, False), (2, False), (-3, False), (-13, False)):
        option, aim = line.controller.choose(at(0.0)[0], goal, 0, (), last_aim)
        assert (option, aim) == (O1, -1) if not goes_on else option == GLOBAL
        assert not goes_on or 0.0 < waypoint(line, aim)[0] < 20.0
    number = int(np.linalg.norm(line.visited.points, axis=1).argmin())
    for x, at_waypoint in ((0.0, True), (4.0, False)):
        begun = state(option=[GLOBAL], aim=[-2 - 2 * number], steps=[5])  # the global option's last step
        ended, outcomes = line.controller.advance(begun, at(x), [goal])
        assert [outcome.success for outcome in outcomes] == [at_waypoint]
        assert (ended.aim[0] < -1) == at_waypoint
        _, _, running = line.controller.act(observe(at(0.0)), ended._replace(failures=np.zeros(1, int)), [goal])
        assert running.option.tolist() == [GLOBAL if at_waypoint else O1], "after a failure it plans anew"


def test_going_on_along_a_way_is_no_decision() -> None:
    """A way of many more waypoints than decisions are allowed is walked to its end."""
    world = World(reach=9)
    world.walk((0, 0), (40, 0), 100)
    request, running, point, n_ends = [Request(at(40.0)[0])], ControllerState.fresh(1), at(0.0), 0
    for _ in range(200):
        _, aims, running = world.controller.act(observe(point), running, request)
        point = point + np.clip(aims - point, -0.5, 0.5)
        running, outcomes = world.controller.advance(running, point, request)
        n_ends += len(outcomes)
        if any(outcome.aim == -1 for outcome in outcomes):
            break
    assert n_ends > MANY_DECISIONS
    assert running.decisions[0] <= 2  # to begin, and to go straight at last
    assert running.failures.tolist() == [0]


def test_on_the_way_to_an_event_no_way_back_to_the_goal_is_begun() -> None:
    """Who has just passed a waypoint on the way to where the graph is entered plans as ever."""
    world = World(reach=30)
    world.add_event(10.0, 0.0)
    option = world.add_option(world.add_event(10.0, 10.0), (10.0, 0.0))
    world.tour([(0, 0), (10, 0), (10, 10)], 20)
    world.walk((2, 0), (2, 8), 16)
    goal = Request(np.array([2.0, 8.0]))
    here = np.array([2.0, 0.0])
    _, aim = world.controller.choose(here, to_event(world, "e1"), 0, ())
    assert aim < -1
    assert aim % 2 == 1, "a waypoint on a way to an event"
    assert waypoint(world, aim)[0] > 2.0
    there = np.array([10.0, 0.0])
    assert world.controller.choose(there, to_event(world, "e1"), 0, (), aim) == (world.controller.index(option), -1)
    _, onward = world.controller.choose(here, goal, 1, (), aim - 1)
    _, anew = world.controller.choose(here, goal, 2, (), aim)
    assert (onward % 2, anew) == (0, -1)


def test_going_round_in_circles_is_failing_too(line: World) -> None:
    """After many decisions the next best way is tried."""
    goal = Request(at(14.0)[0])
    legs = line.planner.legs(at(0.0)[0], goal.goal)
    for decisions, leg in ((0, 0), (MANY_DECISIONS - 1, 0), (MANY_DECISIONS, 1), (2 * MANY_DECISIONS, 2)):
        _, _, running = line.controller.act(observe(at(0.0)), state(decisions=[decisions]), [goal])
        path = legs[leg].path
        assert running.option.tolist() == [GLOBAL if path is None else int(path.vertices[0][1:])]
        assert running.decisions.tolist() == [decisions + 1]


def test_a_waypoint_stays_where_it_is_when_old_trajectories_are_forgotten() -> None:
    world = World(reach=30)
    world.visited.capacity = 100
    world.walk((50, 0), (80, 0), 60)
    world.tour([(0, 0), (9, 0), (9, 8)], 17)
    request = [Request(np.array([9.0, 7.5]))]
    _, aims, running = world.controller.act(observe(at(0.0)), ControllerState.fresh(1), request)
    assert running.aim[0] <= -2
    size = world.visited.size
    world.walk((50, 5), (60, 5), 20)
    assert world.visited.size < size + 20  # some have been forgotten, but not where the agent walks
    running, outcomes = world.controller.advance(running, at(0.0), request)
    assert outcomes == []
    _, again, running = world.controller.act(observe(at(0.0)), running, request)
    np.testing.assert_array_equal(again, aims)
    _, outcomes = world.controller.advance(running, aims, request)
    assert [outcome.success for outcome in outcomes] == [True]


# -- closed loop ------------------------------------------------------------------------------------------------------


def test_it_plans_anew_after_every_option(line: World) -> None:
    controller, request = line.controller, [to_event(line, "e2")]
    actions, aims, running = controller.act(observe(at(0.0)), ControllerState.fresh(1), request)
    assert (running.option.tolist(), running.steps.tolist()) == ([O1], [1])
    np.testing.assert_array_equal(aims, at(10.0))
    assert actions.shape == (1, 2)
    running, outcomes = controller.advance(running, at(5.0), request)
    assert outcomes == []
    _, _, running = controller.act(observe(at(5.0)), running, request)
    assert (running.option.tolist(), running.steps.tolist()) == ([O1], [2])  # no new choice in the middle of a run
    running, outcomes = controller.advance(running, at(10.3), request)
    assert outcomes == [(0, O1, -1, True, 2)]
    assert running.option.tolist() == [UNDECIDED]
    _, aims, running = controller.act(observe(at(10.3)), running, request)
    assert (running.option.tolist(), running.steps.tolist()) == ([O2], [1])
    np.testing.assert_array_equal(aims, at(20.0))


def test_it_plans_from_where_it_landed_not_from_where_it_should_have(line: World) -> None:
    controller, request = line.controller, [to_event(line, "e2")]
    running, _ = controller.advance(state(option=[O2], steps=[10]), at(1.0), request)
    _, _, running = controller.act(observe(at(1.0)), running, request)
    assert running.option.tolist() == [O1]


@pytest.mark.parametrize(("option", "timeout"), [(O1, 10), (GLOBAL, 5)])
def test_options_time_out_the_global_one_sooner(line: World, option: int, timeout: int) -> None:
    request = [to_event(line, "e2")]
    running, outcomes = line.controller.advance(state(option=[option], steps=[timeout - 1]), at(5.0), request)
    assert outcomes == []
    running, outcomes = line.controller.advance(state(option=[option], steps=[timeout]), at(5.0), request)
    assert outcomes == [(0, option, -1, False, timeout)]
    assert running.option.tolist() == [FAILED]


def test_success_beats_a_timeout_on_the_same_step(line: World) -> None:
    request = [to_event(line, "e2")]
    for option, x, steps in ((O1, 10.0, 10), (GLOBAL, 20.0, 5)):
        _, outcomes = line.controller.advance(state(option=[option], steps=[steps]), at(x), request)
        assert outcomes == [(0, option, -1, True, steps)]


def test_the_global_option_ends_where_it_walks_to(line: World) -> None:
    request = [Request(at(14.0)[0])]
    for aim, x, ended in ((1, 10.5, True), (1, 14.0, False), (-1, 14.5, True), (-1, 10.5, False)):
        _, outcomes = line.controller.advance(state(option=[GLOBAL], aim=[aim], steps=[1]), at(x), request)
        assert bool(outcomes) == ended
        assert all(outcome.success and outcome.aim == aim for outcome in outcomes)


def test_a_waypoint_is_reached_within_the_tolerance(line: World) -> None:
    request = [Request(at(14.0)[0])]
    k = int(np.linalg.norm(line.visited.points - at(7.0), axis=1).argmin())
    assert line.controller.tolerance < line.controller.radius
    for x, ended in ((7.4, True), (7.6, False), (6.6, True), (6.4, False)):
        _, outcomes = line.controller.advance(state(option=[GLOBAL], aim=[-2 - 2 * k], steps=[1]), at(x), request)
        assert outcomes == ([(0, GLOBAL, -2 - 2 * k, True, 1)] if ended else [])


def test_the_last_two_options_that_failed_are_remembered(line: World) -> None:
    request = [to_event(line, "e2")]

    def end(running: ControllerState, option: int, x: float, steps: int = 10) -> ControllerState:
        running = running._replace(option=np.array([option]), steps=np.array([steps]))
        after, outcomes = line.controller.advance(running, at(x), request)
        assert len(outcomes) == 1
        return after

    def failed(running: ControllerState) -> tuple[list[int], list[int]]:
        return running.failed_last.tolist(), running.failed_before.tolist()

    first = end(ControllerState.fresh(1), O1, 5.0)
    assert failed(first) == ([O1], [-1])
    assert first.failures.tolist() == [0]  # an option that fails is no failed approach to the goal
    assert failed(end(first, O1, 5.0)) == ([O1], [-1])  # the same once more
    assert failed(end(first, O2, 20.0)) == ([O1], [-1])  # a success
    walked = end(first, GLOBAL, 5.0, steps=5)
    assert failed(walked) == ([O1], [-1])
    assert walked.failures.tolist() == [1]
    second = end(first, O2, 5.0)
    assert failed(second) == ([O2], [O1])
    assert failed(end(second, O1, 5.0)) == ([O1], [O2])
    assert failed(end(second, O3, 5.0)) == ([O3], [O2])


def test_what_failed_is_not_chosen_at_once_again(line: World) -> None:
    """Closed loop: what ``advance`` remembers, ``act`` avoids."""
    detour = line.add_option(line.graph.events["e1"], (0.0, 0.0), failures=5)
    request = [to_event(line, "e2")]
    running = state(option=[O1], steps=[10])
    for expected in (line.controller.index(detour), O1, O1):  # after both have failed, there is no other way
        running, _ = line.controller.advance(running, at(0.0), request)
        _, _, running = line.controller.act(observe(at(0.0)), running, request)
        assert running.option.tolist() == [expected]
        running = running._replace(steps=np.array([10]))


def test_a_walk_to_where_the_graph_can_be_entered_is_an_approach_to_the_goal(line: World) -> None:
    walk = state(option=[GLOBAL], aim=[0], steps=[5])
    running, outcomes = line.controller.advance(walk, at(5.0), [Request(at(14.0)[0])])
    assert [outcome.success for outcome in outcomes] == [False]
    assert running.failures.tolist() == [1]
    for aim in (-1, -2, -9):  # the goal itself, or a waypoint of the way there
        running, _ = line.controller.advance(walk._replace(aim=np.array([aim])), at(50.0), [Request(at(14.0)[0])])
        assert running.failures.tolist() == [1]


def test_inputs_are_left_as_they_were(line: World) -> None:
    controller, requests = line.controller, [to_event(line, "e2"), Request(at(14.0)[0]), to_event(line, "e0")]
    points = at(10.0, 5.0, 10.0).astype(np.float32)
    before = state(3, option=[O1, UNDECIDED, UNDECIDED], steps=[3, 0, 0])
    kept, kept_points = before.copy(), points.copy()
    first, second = (controller.advance(before, points, requests) for _ in range(2))
    assert first[1] == second[1] == [(0, O1, -1, True, 3)]
    observation = observe(points)
    one, other = (controller.act(observation, before, requests) for _ in range(2))
    for a, b in zip(one[2], other[2], strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(one[0], other[0])
    for a, b in zip(before, kept, strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(points, kept_points)
    np.testing.assert_array_equal(observation["achieved_goal"], kept_points)
    for after in (one[2], first[0]):
        assert not any(np.shares_memory(a, b) for a, b in zip(after, before, strict=True))


@pytest.mark.parametrize("n_envs", [1, 2, 5])
def test_environments_do_not_disturb_each_other(line: World, n_envs: int) -> None:
    controller = line.controller
    xs = [0.0, 10.0, 20.0, 5.0, 12.0][:n_envs]
    requests = [to_event(line, id) for id in ("e2", "e0", "e1", "e0", "e2")[:n_envs]]
    actions, aims, running = controller.act(observe(at(*xs)), ControllerState.fresh(n_envs), requests)
    assert actions.shape == aims.shape == (n_envs, 2)
    assert (np.abs(actions) <= 1.0).all()
    assert all(array.shape == (n_envs,) for array in running)
    for i in range(n_envs):
        alone = controller.act(observe(at(xs[i])), ControllerState.fresh(1), [requests[i]])
        np.testing.assert_allclose(actions[i], alone[0][0], atol=1e-6)
        np.testing.assert_array_equal(aims[i], alone[1][0])
        assert [int(array[i]) for array in running] == [int(array[0]) for array in alone[2]]
    ends = np.stack([line.graph.events["e1"].center] * n_envs)
    after, outcomes = controller.advance(running, ends, requests)
    assert all(array.shape == (n_envs,) for array in after)
    assert {outcome.env for outcome in outcomes} == set(np.flatnonzero(after.option == UNDECIDED))


def test_gestating_options_act_with_the_global_policy_only_when_warm_started(line: World) -> None:
    chain = line.chaining.open_chain(line.graph.events["e0"], line.graph.events["e2"])
    root = line.chaining.options[chain.options[0]]
    request = [Request(at(20.0)[0], event="e2", chain=chain.id)]
    cold = line.controller
    warm = Controller(
        line.global_option, line.chaining, line.planner, cold.view, 1.0, 0.5, 10, warm_start=True, stall_steps=None
    )
    observation = observe(at(0.0))
    seen = cold.view(observation["observation"], observation["achieved_goal"], at(20.0))
    for controller, mature, actor in (
        (cold, False, root.actor),
        (warm, False, line.global_option.actor),
        (warm, True, root.actor),
    ):
        root.mature = mature
        actions, _, _ = controller.act(observation, state(option=[controller.index(root)]), request)
        np.testing.assert_array_equal(actions, actor.act(seen))
    assert not np.allclose(root.actor.act(seen), line.global_option.actor.act(seen))


@pytest.mark.parametrize("stall_steps", [3, None])
def test_an_option_that_stands_still_ends_as_failed(line: World, stall_steps: int | None) -> None:
    controller, request = line.controller, [to_event(line, "e1")]
    controller.stall_steps = stall_steps
    state, ends = ControllerState.fresh(1), []
    for step, x in enumerate([0.0, 0.3, 0.6, 0.9, 0.9, 0.95, 0.9, 0.9, 0.9]):  # walks, then trembles against a wall
        state, outcomes = controller.advance(state, at(x), request)
        ends += [(step, outcome.option, outcome.success) for outcome in outcomes]
        _, _, state = controller.act(observe(at(x)), state, request)
    assert ends == ([(7, O1, False)] if stall_steps else [])
    assert int(state.failed_last[0]) == (O1 if stall_steps else -1)


def test_standing_still_counts_anew_for_every_option(line: World) -> None:
    line.controller.stall_steps = 3
    request = [to_event(line, "e1")]
    _, _, state = line.controller.act(observe(at(0.0)), ControllerState.fresh(1)._replace(still=np.array([2])), request)
    assert int(state.still[0]) == 0


def test_what_stood_still_is_shaken_loose(line: World) -> None:
    """After a run that stood still the next one begins with a random action, another one every time; then it acts again."""
    controller, request = line.controller, [to_event(line, "e1")]
    controller.stall_steps = 3
    running, actions, last = ControllerState.fresh(1), [], -1
    for _ in range(3 * (SHAKE + 4)):
        running, outcomes = controller.advance(running, at(0.0), request)
        action, _, after = controller.act(observe(at(0.0)), running, request)
        np.testing.assert_array_equal(action, controller.act(observe(at(0.0)), running, request)[0])  # by the state alone
        last = len(actions) if outcomes else last
        actions.append(action[0])
        running = after
    policy, shaken = actions[0], actions[4 : 4 + SHAKE]
    np.testing.assert_array_equal(actions[3], policy)
    assert all((action == shaken[0]).all() for action in shaken)
    assert not np.allclose(shaken[0], policy)
    assert np.abs(shaken[0]).max() <= 1.0
    np.testing.assert_array_equal(actions[4 + SHAKE], policy)
    assert last > 4
    assert not np.allclose(actions[last], shaken[0])
