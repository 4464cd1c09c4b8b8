"""Plans on hand-built graphs with known answers (sections 3.2.3, 3.2.4 and 3.3)."""

import numpy as np
import pytest
from builders import World

from sb3_skillgraph.planner import RETRACING, Status


def at(x: float, y: float = 0.0) -> np.ndarray:
    return np.array([x, y])


@pytest.fixture
def line() -> World:
    world = World()
    world.line()
    return world


@pytest.mark.parametrize(
    ("goal", "status"),
    [
        (at(10.0), "in_graph"),  # Figure 2 (a)
        (at(10.5, 0.5), "in_graph"),
        (at(12.0), "in_initiation_set"),  # (b): an option starts here, but the region holds no option's effects
        (at(50.0), "outside"),  # (c)
        (at(5.0), "outside"),
    ],
)
def test_the_three_cases_of_a_goal(line: World, goal: np.ndarray, status: Status) -> None:
    assert line.planner.status(goal, 1.0) == status
    assert line.planner.plan(at(0.0), goal, 1.0).status == status


def test_a_region_that_holds_an_options_effects_is_in_the_graph() -> None:
    world = World()
    target = world.add_event(10.0, 0.0)
    option = world.add_option(target, (0.0, 0.0), successes=0)
    for _ in range(10):
        option.succeeded(np.zeros((2, 2)), at(10.9))
    world.graph.refresh(option, refitted=False)
    assert world.planner.status(at(11.5), 1.0) == "in_graph"  # the event's centre lies outside the region
    assert world.planner.status(at(12.5), 1.0) == "outside"
    option.succeeded(np.zeros((2, 2)), at(9.5))
    assert world.planner.status(at(11.5), 1.0) == "in_graph"  # ten of eleven
    option.succeeded(np.zeros((2, 2)), at(9.5))
    assert world.planner.status(at(11.5), 1.0) == "outside"  # ten of twelve


def test_an_empty_world_has_no_plan() -> None:
    world = World()
    assert world.planner.plan(at(0.0), at(5.0), 1.0) == ("outside", (), np.inf, 0.0)
    assert world.planner.legs(at(0.0), at(5.0)) == []
    assert world.planner.entry(at(0.0), None) is None
    assert world.planner.coverage() == 0.0


def test_a_plan_over_the_graph(line: World) -> None:
    plan = line.planner.plan(at(0.0), at(20.0), 1.0)
    assert plan.path[0] == "o1"
    assert plan.path[-1] == "e2"
    assert set(plan.path) <= {"o1", "e1", "o2", "e2"}
    rate = 9 / 10  # eight successes and two pseudo-counts
    assert plan.success_probability == pytest.approx(rate**2)
    assert plan.cost == pytest.approx(2 / rate)


def test_no_plan_starts_outside_its_first_options_initiation_set(line: World) -> None:
    assert line.planner.path_to(at(5.0), "e2") is None
    path = line.planner.path_to(at(12.0), "e2")
    assert path is not None
    assert path.vertices == ("o2", "e2")


def test_a_detour_around_an_option_that_has_just_failed(line: World) -> None:
    only = line.planner.path_to(at(0.0), "e1")
    assert only is not None
    assert line.planner.path_to(at(0.0), "e1", avoid=["o1"]) == only  # nothing else leads there
    line.add_option(line.graph.events["e1"], (0.0, 0.0), failures=5)
    best, second = line.planner.path_to(at(0.0), "e1"), line.planner.path_to(at(0.0), "e1", avoid=["o1"])
    assert best is not None
    assert second is not None
    assert (best.vertices, second.vertices) == (("o1", "e1"), ("o5", "e1"))
    assert best.cost < second.cost
    assert second.success_probability == pytest.approx(6 / 12)
    assert line.planner.path_to(at(0.0), "e1", avoid=["o5"]) == best
    assert line.planner.path_to(at(0.0), "e1", avoid=["o5", "o1"]) == best  # nothing else leads there
    assert line.planner.path_to(at(0.0), "e1", avoid=["o9"]) == best  # not in the graph


def test_a_plan_never_runs_through_an_option_that_failed_lately_if_there_is_another_way(line: World) -> None:
    """Wherever on the way it lies, and however dear the other way is."""
    line.add_option(line.graph.events["e2"], (10.0, 0.0), failures=5)
    first, second = line.planner.path_to(at(0.0), "e2"), line.planner.path_to(at(0.0), "e2", avoid=["o2"])
    assert first is not None
    assert second is not None
    assert [id for id in first.vertices if id[0] == "o"] == ["o1", "o2"]
    assert [id for id in second.vertices if id[0] == "o"] == ["o1", "o5"]
    assert second.cost > first.cost
    assert line.planner.path_to(at(0.0), "e2", avoid=["o2", "o5"]) == first
    paths = [leg.path.vertices for leg in line.planner.legs(at(0.0), at(20.0), ["o2"]) if leg.path is not None]
    assert paths
    assert not any("o2" in path for path in paths)


def test_an_option_that_would_end_at_once_begins_no_plan(line: World) -> None:
    line.add_option(line.graph.events["e0"], (0.0, 0.0), successes=40)  # sure of what is so already
    assert "o5" in line.graph.startable(at(0.0))
    assert line.graph.useful(at(0.0)) == ["o1"]
    path = line.planner.path_to(at(0.0), "e0")
    assert path is None or path.vertices[0] == "o1"


def test_event_at_is_the_nearest_event_that_holds_the_point(line: World) -> None:
    line.add_event(11.0, 0.0)
    assert [e.id if (e := line.planner.event_at(at(x))) else None for x in (0.4, 5.0, 10.2, 10.8)] == [
        "e0",
        None,
        "e1",
        "e3",
    ]


def test_the_nearest_vertex_is_nearest_in_steps_and_walls_do_not_fool_it() -> None:
    """A goal behind a wall: near to e1 as the crow flies, but reached from e0."""
    for nearest, expected in (("steps", ["e0"]), ("euclidean", ["e1", "e0"])):
        world = World(nearest=nearest)
        world.add_event(0.0, 0.0)
        world.add_event(10.0, 0.0)
        world.walk((0, 0), (10, 2), 30)
        ranked = world.planner.vertices_near(at(10.0, 2.0))
        assert [event.id for event, _ in ranked] == expected
        assert [distance for _, distance in ranked] == sorted(distance for _, distance in ranked)


def test_coming_back_from_a_goal_tells_less_than_going_there() -> None:
    world = World()
    world.add_event(0.0, 0.0)
    world.add_event(10.0, 0.0)
    world.walk((5, 0), (0, 0), 20)  # back to e0: in so many steps, and half as many again for doubt
    world.walk((10, 0), (5, 0), 20)  # from e1 there
    [(first, there), (second, back)] = world.planner.vertices_near(at(5.0))
    assert (first.id, second.id) == ("e1", "e0")
    assert back / there == pytest.approx(1.5, rel=0.2)


def test_an_event_that_nothing_leads_to_is_none_to_leave_the_graph_at(line: World) -> None:
    """The goal of an adaptation is such an event: the graph is left where the way to it began."""
    goal = line.add_event(20.0, 10.0)
    line.walk((20, 0), (20, 10), 30)
    ranked = [event.id for event, _ in line.planner.vertices_near(goal.center)]
    assert (ranked[0], goal.id in ranked) == ("e2", False)
    legs = line.planner.legs(at(0.0), goal.center)
    assert legs[0].path is not None
    assert legs[0].path.vertices[-1] == "e2"
    option = line.add_option(goal, (20.0, 0.0))
    assert next(iter(line.planner.vertices_near(goal.center)))[0] is goal
    assert option.id in line.planner.plan(at(0.0), goal.center, 1.0).path


def test_legs_are_sorted_and_add_up(line: World) -> None:
    legs = line.planner.legs(at(0.0), at(14.0))
    assert [leg.cost for leg in legs] == sorted(leg.cost for leg in legs)
    assert sorted(str(leg.event) for leg in legs) == ["None", "e1", "e2"]
    assert legs[0].event == "e1"
    first = legs[0]
    assert first.path is not None
    assert first.path.vertices == ("o1", "e1")
    steps = {event.id: n for event, n in line.planner.vertices_near(at(14.0))}
    assert first.cost == pytest.approx(first.path.cost + steps["e1"] / line.planner.reach)


def test_a_long_way_retraced_costs_more_than_a_short_one() -> None:
    world = World(reach=20)
    world.walk((0, 0), (30, 0), 60)
    for x in (2.0, 9.0, 10.5, 15.0, 29.0):
        steps = world.visited.steps_between(at(0.0), at(x), (1.0, 0.5))
        [leg] = world.planner.legs(at(0.0), at(x))
        assert (leg.event, leg.path) == (None, None)
        assert leg.cost == pytest.approx(steps / 20 * (1.0 if steps <= 20 else RETRACING))
    assert world.planner.legs(at(29.0), at(2.0)) == []  # nobody went back
    assert world.planner.legs(at(0.0, 3.0), at(2.0)) == []  # nor from there


def test_a_goal_close_at_hand_is_walked_to_directly(line: World) -> None:
    legs = line.planner.legs(at(10.0), at(14.0))
    assert legs[0].path is None
    assert line.planner.plan(at(10.0), at(14.0), 1.0).path == ("e1",)


def test_a_plan_without_a_path_promises_nothing(line: World) -> None:
    """``path`` is empty if no path leads there; then the cost is infinite and the probability 0."""
    for x in (5.0, 12.0, 15.0, 50.0, -30.0):
        for goal in (7.0, 14.0, 60.0, -40.0):
            plan = line.planner.plan(at(x), at(goal), 1.0)
            if not plan.path:
                assert (plan.cost, plan.success_probability) == (np.inf, 0.0), (x, goal)


def test_the_graph_is_entered_where_it_leads_on(line: World) -> None:
    entry = line.planner.entry(at(5.0), "e2")
    assert entry is not None
    assert entry.id in ("e0", "e1")
    for id in ("o1", "o2"):
        line.graph.remove_options([id])
    assert line.planner.entry(at(5.0), "e2") is None  # from what lies next, nothing leads there any more
    inside = line.planner.entry(at(0.0), None)
    assert inside is None or inside.id != "e0"  # it is there already


def test_coverage_is_the_share_of_visited_states_one_can_go_on_from(line: World) -> None:
    assert line.planner.coverage() == pytest.approx((3 + 6 + 3) / 20, abs=0.05)
    line.add_option(line.graph.events["e0"], (10.0, 0.0), start_radius=30.0)
    assert line.planner.coverage() == 1.0
