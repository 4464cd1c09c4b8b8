"""Events, edges and the records of runs: what the skill graph keeps."""

import copy
import io
import json
from typing import Any
from unittest import mock

import networkx as nx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_skillgraph import graph as graph_module
from sb3_skillgraph.edges import MAX_LANDINGS, NOWHERE, Edges
from sb3_skillgraph.events import Event
from sb3_skillgraph.graph import GROWTH, SPACING, YOUNG, SkillGraph
from sb3_skillgraph.metric import MISMATCH, Exact, Product, Within

every_time = settings(derandomize=True, deadline=None, max_examples=40, database=None)


def line(n_events: int, spacing: float = 2.0, **kwargs: Any) -> SkillGraph:
    """A graph with events of radius 1 on the first axis of the plane."""
    graph = SkillGraph(2, 1.0, kwargs.get("max_events", 100))
    for i in range(n_events):
        graph.add_event(np.array([spacing * i, 0.0]), salient=i in kwargs.get("salient", ()))
    return graph


def test_events_that_only_what_has_to_match_tells_apart_are_not_merged() -> None:
    graph = SkillGraph(2, Product(Within((0,), 1.0), Exact((1,))), 10)
    for i in range(10):
        graph.add_event(np.array([0.0, i]), salient=False)
    with pytest.raises(ValueError, match=r"more values than max_events=10"):
        while len(graph.events) == 10:
            graph.coarsen()
    assert len(graph.events) == 10 and graph.cover_radius < MISMATCH


def record(graph: SkillGraph, source: int, target: int) -> dict[str, float]:
    row = graph.edges.find(source, target)
    assert row is not None
    columns = ("forward", "backward", "crossing_steps", "successes", "success_steps", "failures")
    return {name: float(getattr(graph.edges, name)[row]) for name in columns}


def landings(graph: SkillGraph, source: int, target: int) -> dict[int, float]:
    row = graph.edges.find(source, target)
    pairs = zip(graph.edges.landing[row].tolist(), graph.edges.landing_weight[row].tolist(), strict=True)
    return {landing: weight for landing, weight in pairs if weight > 0.0}


def same(a: Any, b: Any) -> bool:
    """Whether two trees of plain data are equal, bit for bit."""
    if isinstance(a, dict):
        return isinstance(b, dict) and list(a) == list(b) and all(same(a[key], b[key]) for key in a)
    if isinstance(a, list):
        return isinstance(b, list) and len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    if isinstance(a, np.ndarray):
        return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
    return bool(a == b)


# -- events -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("center", [[np.nan, 0.0], [[0.0, 1.0]], [np.inf]])
def test_an_event_needs_a_finite_centre(center: list[Any]) -> None:
    with pytest.raises(ValueError, match="finite centre"):
        Event("e0", np.array(center), 1.0)


@pytest.mark.parametrize("radius", [0.0, -1.0, np.nan])
def test_an_event_needs_a_positive_radius(radius: float) -> None:
    with pytest.raises(ValueError, match="positive number"):
        Event("e0", np.zeros(2), radius)


def test_an_event_tells_of_single_points_what_it_tells_of_many() -> None:
    event = Event("e0", np.array([1.0, -1.0, 0.5]), 0.7)
    points = np.random.default_rng(0).normal(event.center, 0.5, (200, 3))
    inside = event.contains(points)
    assert 20 < inside.sum() < 180
    assert inside.tolist() == [event.holds(point) for point in points]


def test_an_event_and_the_walk_to_it_have_one_index_and_ids_of_their_own() -> None:
    graph = line(3)
    assert [event.id for event in graph.events] == ["e0", "e1", "e2"]
    assert graph.walk_ids == ["w0", "w1", "w2"]
    assert graph.index("e1") == graph.index("w1") == 1
    assert graph.id(1) == "e1"
    assert graph.id(NOWHERE) == ""
    assert [graph.index(id) for id in ("", "goal", "direct", "e3", "1")] == [NOWHERE] * 5


def test_without_events_every_point_is_nowhere() -> None:
    assert line(0).locate(np.zeros(2)) == NOWHERE


@every_time
@given(st.integers(0, 10_000), st.integers(1, 150))
def test_a_point_belongs_to_the_nearest_event_within_the_cover(seed: int, n_events: int) -> None:
    rng = np.random.default_rng(seed)
    graph = SkillGraph(2, 0.5, 1000)
    centers = rng.uniform(-5.0, 5.0, (n_events, 2))
    for center in centers:
        graph.add_event(center, salient=False)
    np.testing.assert_array_equal(graph.centers, centers)
    for point in rng.uniform(-6.0, 6.0, (20, 2)):
        distances = np.linalg.norm(centers - point, axis=1)
        np.testing.assert_allclose(graph.distances(point), distances)
        expected = int(distances.argmin()) if distances.min() <= SPACING * 0.5 else NOWHERE
        assert graph.locate(point) == expected


def test_an_event_keeps_its_place_when_the_array_it_was_made_from_changes() -> None:
    graph, center = SkillGraph(2, 1.0, 10), np.zeros(2)
    graph.add_event(center, salient=False)
    center += 5.0
    assert graph.locate(np.zeros(2)) == 0
    assert graph.events[0].center.tolist() == [0.0, 0.0]


# -- crossings --------------------------------------------------------------------------------------------------------


def test_a_crossing_makes_an_edge_and_the_way_back_a_guess() -> None:
    graph = line(2)
    graph.crossed(0, 1, 12)
    assert record(graph, 0, 1) == dict(
        forward=1.0, backward=0.0, crossing_steps=12.0, successes=0.0, success_steps=0.0, failures=0.0
    )
    assert record(graph, 1, 0) == dict(
        forward=0.0, backward=1.0, crossing_steps=12.0, successes=0.0, success_steps=0.0, failures=0.0
    )
    assert graph.edges.find(0, 0) is None


def test_the_steps_of_a_crossing_are_a_mean_of_each_direction() -> None:
    graph = line(2)
    for steps in (10, 20, 30):
        graph.crossed(0, 1, steps)
    assert record(graph, 0, 1)["crossing_steps"] == pytest.approx(20.0)
    assert record(graph, 1, 0)["crossing_steps"] == pytest.approx(20.0)  # as long as nobody went back
    graph.crossed(1, 0, 5)
    assert record(graph, 1, 0)["crossing_steps"] == 5.0
    assert record(graph, 0, 1)["crossing_steps"] == pytest.approx(20.0)


def test_the_steps_of_a_crossing_follow_the_walker() -> None:
    graph = line(2)
    for steps in [40] * 50 + [10] * 50:
        graph.crossed(0, 1, steps)
    assert 10.0 <= record(graph, 0, 1)["crossing_steps"] < 11.0  # the plain mean would be 25


# -- runs -------------------------------------------------------------------------------------------------------------


def test_runs_count_and_keep_the_steps_of_the_successful_ones() -> None:
    graph = line(3)
    graph.crossed(0, 1, 10)
    graph.ran(0, 1, True, 1, 8)
    graph.ran(0, 1, True, 1, 12)
    graph.ran(0, 1, False, 2, 35)
    graph.ran(0, 1, False, NOWHERE, 35)
    assert record(graph, 0, 1) == dict(
        forward=1.0, backward=0.0, crossing_steps=10.0, successes=2.0, success_steps=20.0, failures=2.0
    )
    assert landings(graph, 0, 1) == {2: 1.0, NOWHERE: 1.0}
    assert record(graph, 1, 0)["failures"] == 0.0


def test_records_lose_half_their_weight_when_half_of_the_training_is_later() -> None:
    graph = line(3)
    graph.now = 1_000.0
    graph.crossed(0, 1, 10)
    for landing in (0, 2, 2):
        graph.ran(0, 1, False, landing, 35)
    graph.ran(0, 1, True, 1, 10)
    graph.now = 2.0 * (1_000.0 + YOUNG) - YOUNG
    assert graph.aging()[graph.edges.find(0, 1)] == pytest.approx(0.5)
    assert record(graph, 0, 1)["failures"] == 3.0  # weights are as of when they were written
    graph.ran(0, 1, True, 1, 20)
    assert record(graph, 0, 1)["failures"] == pytest.approx(1.5)
    assert record(graph, 0, 1)["successes"] == pytest.approx(1.5)
    assert record(graph, 0, 1)["success_steps"] == pytest.approx(25.0)
    assert landings(graph, 0, 1) == {0: pytest.approx(0.5), 2: pytest.approx(1.0)}
    assert graph.aging()[graph.edges.find(0, 1)] == 1.0
    assert record(graph, 0, 1)["forward"] == 1.0  # what was crossed was crossed


@every_time
@given(st.lists(st.tuples(st.floats(0.0, 2_000.0), st.booleans()), min_size=1, max_size=12), st.floats(0.0, 5_000.0))
def test_a_record_weighs_what_its_runs_weigh_each_by_its_age(runs: list[tuple[float, bool]], later: float) -> None:
    graph = line(2)
    graph.crossed(0, 1, 10)
    written = []
    for wait, success in runs:
        graph.now += wait
        graph.ran(0, 1, success, 0, 10)
        written.append((graph.now, success))
    graph.now += later
    weights = [((time + YOUNG) / (graph.now + YOUNG), success) for time, success in written]
    row, aging = graph.edges.find(0, 1), graph.aging()
    assert graph.edges.successes[row] * aging[row] == pytest.approx(sum(w for w, success in weights if success))
    assert graph.edges.failures[row] * aging[row] == pytest.approx(sum(w for w, success in weights if not success))


def test_of_many_landings_the_most_frequent_are_told_apart() -> None:
    graph = line(20)
    graph.crossed(0, 1, 10)
    for landing in [5] * 6 + [6] * 5 + [7] * 4 + list(range(8, 20)):
        graph.ran(0, 1, False, landing, 35)
    told = landings(graph, 0, 1)
    assert len(told) == MAX_LANDINGS
    assert {5: 6.0, 6: 5.0, 7: 4.0}.items() <= told.items()
    assert record(graph, 0, 1)["failures"] == 27.0


def test_nowhere_is_a_landing_like_others() -> None:
    graph = line(2)
    graph.crossed(0, 1, 10)
    for _ in range(3):
        graph.ran(0, 1, False, NOWHERE, 35)
    assert landings(graph, 0, 1) == {NOWHERE: 3.0}


def test_edges_survive_growing_past_their_first_room() -> None:
    edges = Edges()
    pairs = [(i, j) for i in range(15) for j in range(15) if i != j]
    for k, (i, j) in enumerate(pairs):
        row = edges.add(i, j, float(k))
        assert row == k
        edges.forward[row] = k
    assert edges.size == len(pairs) == 210
    assert [(int(i), int(j)) for i, j in zip(edges.source, edges.target, strict=True)] == pairs
    assert edges.forward.tolist() == edges.updated.tolist() == list(range(210))
    assert (edges.landing == NOWHERE).all()
    assert edges.add(3, 4, 9.0) == pairs.index((3, 4))
    assert edges.size == 210
    with pytest.raises(AttributeError):
        edges.no_such_column  # noqa: B018


# -- bounds -----------------------------------------------------------------------------------------------------------


def test_events_let_go_of_the_edges_worth_least_only() -> None:
    graph = line(12)
    for i in range(1, 12):
        graph.crossed(0, i, i)
        graph.ran(0, i, True, i, i)
    worth = graph.edges.target.astype(float)
    with mock.patch.object(graph_module, "MAX_DEGREE", 5):
        graph.bound_degree(worth)
    assert graph.edges.target[graph.edges.source == 0].tolist() == [7, 8, 9, 10, 11]
    for i in range(7, 12):
        assert record(graph, 0, i)["success_steps"] == record(graph, 0, i)["crossing_steps"] == i
    assert [graph.edges.find(0, i) for i in range(1, 7)] == [None] * 6
    assert graph.edges.let_go == {(0, i) for i in range(1, 7)}  # that somebody went there is still known
    for i in range(1, 12):  # the others have one edge each
        row = graph.edges.find(i, 0)
        assert (graph.edges.source[row], graph.edges.target[row], graph.edges.backward[row]) == (i, 0, 1.0)


def test_a_guess_that_is_let_go_of_was_no_more_than_a_guess() -> None:
    graph = line(9)
    for i in range(1, 9):
        graph.crossed(i, 0, i)  # back, from 0 to all of them, it is a guess
    with mock.patch.object(graph_module, "MAX_DEGREE", 3):
        graph.bound_degree(np.ones(graph.edges.size))
    assert np.bincount(graph.edges.source)[0] == 3
    assert not graph.edges.let_go


def test_where_somebody_went_is_known_of_merged_events_and_of_restored_graphs_too() -> None:
    graph = line(8, spacing=1.6, salient=(0, 3, 7))
    for i in range(1, 8):
        graph.crossed(0, i, i)
    with mock.patch.object(graph_module, "MAX_DEGREE", 1):
        graph.bound_degree(graph.edges.target.astype(float))
    restored = SkillGraph(2, 1.0, 100)
    restored.set_state(copy.deepcopy(graph.get_state()))
    assert restored.edges.let_go == graph.edges.let_go == {(0, i) for i in range(1, 7)}
    new_index = graph.coarsen()
    assert [event.id for event in graph.events] == ["e0", "e3", "e5", "e7"]
    assert graph.edges.let_go >= {(0, int(new_index[i])) for i in (2, 3, 5)}


def test_of_edges_that_are_worth_the_same_the_oldest_stay() -> None:
    graph = line(9)
    for i in (5, 3, 8, 1):
        graph.crossed(0, i, 10)
    with mock.patch.object(graph_module, "MAX_DEGREE", 2):
        graph.bound_degree(np.ones(graph.edges.size))
    assert graph.edges.target[graph.edges.source == 0].tolist() == [5, 3]


def test_an_event_with_few_edges_keeps_them_all() -> None:
    graph = line(4)
    for i in range(1, 4):
        graph.crossed(0, i, 10)
    version = graph.version
    graph.bound_degree(np.zeros(graph.edges.size))
    assert graph.edges.size == 6
    assert graph.version == version


def test_events_too_close_together_merge_and_salient_ones_stay() -> None:
    graph = line(6, spacing=1.6, salient=(1, 4))
    new_index = graph.coarsen()
    assert graph.cover_radius == pytest.approx(GROWTH * SPACING)
    assert [event.id for event in graph.events] == ["e1", "e4"]
    assert graph.walk_ids == ["w1", "w4"]
    assert new_index.tolist() == [0, 0, 0, 1, 1, 1]
    assert (graph.index("e4"), graph.index("w4"), graph.index("e0"), graph.index("w0")) == (1, 1, NOWHERE, NOWHERE)
    np.testing.assert_array_equal(graph.centers, [[1.6, 0.0], [6.4, 0.0]])


def test_records_of_merged_events_become_one() -> None:
    graph = line(6, spacing=1.6, salient=(1, 4))
    graph.crossed(0, 1, 3)  # within one event from now on
    graph.crossed(0, 3, 10)
    graph.crossed(2, 4, 20)
    graph.crossed(2, 4, 20)
    graph.ran(0, 3, True, 3, 9)
    graph.ran(2, 4, False, 5, 35)
    graph.ran(2, 4, False, NOWHERE, 35)
    graph.ran(2, 4, False, 1, 35)
    graph.now = YOUNG
    graph.coarsen()
    assert graph.edges.size == 2
    merged = record(graph, 0, 1)
    assert merged["forward"] == 3.0
    assert merged["crossing_steps"] == pytest.approx(50 / 3)
    assert merged["successes"] == pytest.approx(0.5)  # half a training ago
    assert merged["success_steps"] == pytest.approx(4.5)
    assert merged["failures"] == pytest.approx(1.5)
    assert landings(graph, 0, 1) == {1: pytest.approx(0.5), NOWHERE: pytest.approx(0.5), 0: pytest.approx(0.5)}
    assert record(graph, 1, 0)["backward"] == 3.0
    assert graph.aging().tolist() == [1.0, 1.0]


@every_time
@given(st.integers(0, 10_000), st.integers(2, 60))
def test_what_is_left_after_merging_lies_apart_and_everyone_goes_to_the_nearest(seed: int, n_events: int) -> None:
    rng = np.random.default_rng(seed)
    graph = SkillGraph(2, 1.0, 100)
    for center in rng.uniform(0.0, 8.0, (n_events, 2)):
        i = graph.add_event(center, salient=bool(rng.random() < 0.2))
        graph.visits[i], graph.barren[i] = rng.integers(1, 9, 2)
    centers, totals = graph.centers.copy(), [counts[:n_events].sum() for counts in (graph.visits, graph.barren)]
    new_index = graph.coarsen()
    between = np.linalg.norm(graph.centers[:, None] - graph.centers, axis=2)
    np.fill_diagonal(between, np.inf)
    assert between.min() >= graph.cover_radius
    assert new_index.shape == (n_events,)
    distances = np.linalg.norm(centers[:, None] - graph.centers, axis=2)
    np.testing.assert_array_equal(new_index, distances.argmin(axis=1))
    assert distances.min(axis=1).max() < graph.cover_radius  # nobody ends up nowhere
    for counts, total in zip((graph.visits, graph.barren), totals, strict=True):
        assert counts[: len(graph.events)].sum() == total
        assert not counts[len(graph.events) :].any()


# -- any history ------------------------------------------------------------------------------------------------------

operations = st.lists(
    st.tuples(
        st.sampled_from(["event", "cross", "cross", "run", "run", "wait", "bound", "coarsen"]),
        st.integers(0, 50),
        st.integers(0, 50),
        st.booleans(),
    ),
    max_size=60,
)


class History:
    """Applies operations to a graph; events are picked by number, wrapped around."""

    def __init__(self) -> None:
        self.graph = line(4)
        self.ids = {event.id for event in self.graph.events}

    def apply(self, kind: str, i: int, j: int, flag: bool) -> None:
        graph = self.graph
        source, target = i % len(graph.events), j % len(graph.events)
        if kind == "event":
            made = graph.add_event(np.array([0.7 * i, 0.9 * j]), salient=flag)
            assert graph.events[made].id not in self.ids
            self.ids.add(graph.events[made].id)
        elif kind == "cross" and source != target:
            graph.crossed(source, target, 1 + (i + j) % 40)
        elif kind == "run" and graph.edges.find(source, target) is not None:
            landing = target if flag else (i * j) % (len(graph.events) + 1) - 1
            graph.ran(source, target, flag, landing, 1 + i)
        elif kind == "wait":
            graph.now += 50.0 * i
        elif kind == "bound":
            with mock.patch.object(graph_module, "MAX_DEGREE", 3):
                graph.bound_degree(graph.edges.successes + graph.edges.forward)
            assert np.bincount(graph.edges.source, minlength=1).max() <= 3
        elif kind == "coarsen" and i < 10:
            graph.coarsen()


def check(graph: SkillGraph) -> None:
    edges, n = graph.edges, len(graph.events)
    pairs = list(zip(edges.source.tolist(), edges.target.tolist(), strict=True))
    assert len(set(pairs)) == edges.size
    assert [edges.find(*pair) for pair in pairs] == list(range(edges.size))
    for source, target in pairs:
        assert source != target
        assert 0 <= source < n
        assert 0 <= target < n
    assert all(0 <= source < n and 0 <= target < n and source != target for source, target in edges.let_go)
    assert (edges.forward + edges.backward > 0).all()
    assert (edges.crossing_steps >= 1).all()
    for column in (edges.successes, edges.success_steps, edges.failures, edges.landing_weight):
        assert np.isfinite(column).all()
        assert (column >= 0).all()
    assert (edges.landing_weight.sum(axis=1) <= edges.failures + 1e-9).all()
    assert ((edges.landing >= NOWHERE) & (edges.landing < n)).all()
    assert (edges.updated <= graph.now).all()
    for i, (event, walk) in enumerate(zip(graph.events, graph.walk_ids, strict=True)):
        assert graph.index(event.id) == graph.index(walk) == i
        assert event.id[1:] == walk[1:]
        np.testing.assert_array_equal(event.center, graph.centers[i])


@every_time
@given(operations)
def test_every_history_leaves_a_sound_graph_that_goes_on_as_its_copy_does(history: list[tuple[str, int, int, bool]]) -> None:
    applied = History()
    half = len(history) // 2
    for operation in history[:half]:
        applied.apply(*operation)
        check(applied.graph)
    restored = History()
    restored.graph = SkillGraph(2, 1.0, 100)
    restored.graph.set_state(copy.deepcopy(applied.graph.get_state()))
    restored.ids = set(applied.ids)
    assert same(restored.graph.get_state(), applied.graph.get_state())
    for operation in history[half:]:
        applied.apply(*operation)
        restored.apply(*operation)
    check(restored.graph)
    assert same(restored.graph.get_state(), applied.graph.get_state())


def test_a_state_is_no_view_of_the_graph() -> None:
    graph = line(2)
    graph.crossed(0, 1, 10)
    state = graph.get_state()
    before = copy.deepcopy(state)
    graph.crossed(0, 1, 20)
    graph.ran(0, 1, False, 0, 9)
    graph.visits[0] += 1
    graph.explored("e0", found=False)
    graph.add_event(np.ones(2) * 9, salient=True)
    assert same(state, before)


def test_explorations_are_counted_until_one_finds_something_and_those_of_forgotten_events_are_not() -> None:
    graph = line(5, spacing=0.5)
    for event in ("e0", "e0", "e3", ""):
        graph.explored(event, found=False)
    assert graph.barren[:5].tolist() == [2.0, 0.0, 0.0, 1.0, 0.0]
    graph.coarsen()
    assert graph.barren[:2].tolist() == [2.0, 1.0]  # of those merged with others, too
    graph.explored("e3", found=False)  # it is gone
    graph.explored("e0", found=True)
    assert graph.barren[:2].tolist() == [0.0, 1.0]


def test_ids_of_merged_events_are_not_given_again() -> None:
    graph = line(5, spacing=0.5)
    graph.coarsen()
    assert [event.id for event in graph.events] == ["e0", "e4"]
    graph.add_event(np.array([50.0, 0.0]), salient=False)
    assert graph.events[-1].id == "e5"
    restored = SkillGraph(2, 1.0, 100)
    restored.set_state(graph.get_state())
    restored.add_event(np.array([60.0, 0.0]), salient=False)
    assert restored.events[-1].id == "e6"
    assert restored.walk_ids == ["w0", "w4", "w5", "w6"]


def test_the_version_rises_with_every_change() -> None:
    graph = line(2)
    versions = [graph.version]
    changes = [
        lambda: graph.crossed(0, 1, 10),
        lambda: graph.ran(0, 1, True, 1, 10),
        lambda: graph.ran(0, 1, False, 0, 10),
        lambda: graph.add_event(np.ones(2), salient=False),
        lambda: graph.coarsen(),
        lambda: setattr(graph, "now", 7.0),
        lambda: graph.set_state(graph.get_state()),
    ]
    for change in changes:
        change()
        versions.append(graph.version)
    assert versions == sorted(set(versions))


# -- as networkx has it -----------------------------------------------------------------------------------------------


def test_the_networkx_graph_carries_records_and_where_runs_landed() -> None:
    graph = line(3, salient=(2,))
    graph.crossed(0, 1, 10)
    graph.crossed(2, 1, 14)
    graph.ran(0, 1, True, 1, 8)
    graph.ran(0, 1, False, 2, 35)
    graph.ran(2, 1, False, 2, 35)
    graph.ran(2, 1, False, NOWHERE, 35)
    drawn = graph.nx
    assert set(drawn) == {"e0", "e1", "e2", "w0", "w1", "w2"}
    assert drawn.nodes["e2"] == {"kind": "event", "salient": True, "radius": 1.0, "x0": 4.0, "x1": 0.0}
    assert drawn.nodes["w2"] == {"kind": "walk", "target": "e2"}
    assert drawn.edges["e0", "w1"] == {
        "forward": 1.0, "backward": 0.0, "crossing_steps": 10.0, "successes": 1.0, "success_steps": 8.0, "failures": 1.0,
        "failure_steps": 35.0,
    }  # fmt: skip
    assert drawn.edges["w1", "e1"]["rate"] == pytest.approx(0.25)
    assert drawn.edges["w1", "e2"]["rate"] == pytest.approx(0.5)
    assert set(drawn.successors("w1")) == {"e1", "e2"}
    assert set(drawn.successors("w0")) == set()  # nobody has run it


@every_time
@given(operations)
def test_the_networkx_graph_can_be_written_whatever_has_happened(history: list[tuple[str, int, int, bool]]) -> None:
    applied = History()
    for operation in history:
        applied.apply(*operation)
    graph = applied.graph
    file = io.BytesIO()
    nx.write_graphml(graph.nx, file)
    file.seek(0)
    read = nx.read_graphml(file)
    assert set(read) == set(graph.nx)
    assert set(read.edges) == set(graph.nx.edges)
    assert json.loads(json.dumps(nx.node_link_data(graph.nx, edges="edges")))["directed"]
    assert sum(graph.nx.nodes[source]["kind"] == "event" for source, _ in graph.nx.edges) == graph.edges.size
    for walk in graph.walk_ids:
        rates = [edge["rate"] for _, _, edge in graph.nx.out_edges(walk, data=True)]
        assert all(rate > 0 for rate in rates)
        assert sum(rates) <= 1.0 + 1e-9


def test_the_networkx_graph_is_made_anew_only_after_a_change() -> None:
    graph = line(2)
    first = graph.nx
    assert graph.nx is first
    graph.crossed(0, 1, 10)
    assert graph.nx is not first
    assert graph.nx.number_of_edges() == 2
    assert first.number_of_edges() == 0
