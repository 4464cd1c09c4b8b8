"""What trajectories and runs teach the graph: landmarks, crossings, records, and the model of untried walks."""

import copy

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_skillgraph.choice_model import ChoiceModel
from sb3_skillgraph.choices import EXPECTED
from sb3_skillgraph.graph import MAX_DEGREE, SkillGraph
from sb3_skillgraph.learning.growth import Growth
from sb3_skillgraph.learning.witness import FIT_EVERY, Witness
from sb3_skillgraph.running import Run
from sb3_skillgraph.walk_model import FIRST_GUESS, HASTY_LOSS, WalkModel, timeout

seeds = st.integers(0, 100_000)
every_time = settings(derandomize=True, deadline=None, max_examples=30, database=None)


def make_witness(n_envs: int = 1, *, walk_steps: int = 40, max_events: int = 100) -> Witness:
    """A witness of trajectories in the plane, where events have radius 1 and belong to those within 1.5."""
    graph = SkillGraph(2, 1.0, max_events, walk_steps)
    return Witness(graph, ChoiceModel(graph, WalkModel()), n_envs, Growth("never", graph, {}))  # type: ignore[arg-type]


def walk(witness: Witness, xs: list[float], env: int = 0, y: float = 0.0) -> list[bool]:
    """Let a trajectory go along the first axis; return where it was new."""
    witness.begin(env, np.array([xs[0], y]))
    return [witness.step(env, np.array([x, y])) for x in xs[1:]]


def straight(length: float, step: float = 0.5) -> list[float]:
    return np.arange(0.0, length + 1e-9, step).tolist()


def crossings(graph: SkillGraph) -> dict[tuple[str, str], tuple[float, float, float]]:
    """Forward, backward and steps of all edges, by ids."""
    edges = graph.edges
    columns = (edges.source, edges.target, edges.forward, edges.backward, edges.crossing_steps)
    rows = zip(*(column.tolist() for column in columns), strict=True)
    return {(graph.id(source), graph.id(target)): tuple(numbers) for source, target, *numbers in rows}


def forward(graph: SkillGraph) -> set[tuple[str, str]]:
    return {pair for pair, (there, _, _) in crossings(graph).items() if there > 0}


def run(
    event: str, option: str, success: bool, *, landing: str = "", steps: int = 10, aim: tuple[float, float] = (0.0, 0.0)
) -> Run:
    return Run(0, event, option, landing, success, steps, np.array(aim))


# -- landmarks --------------------------------------------------------------------------------------------------------


def test_a_place_that_belongs_to_no_event_becomes_a_landmark() -> None:
    witness = make_witness()
    new = walk(witness, straight(5.0))
    graph = witness.graph
    np.testing.assert_array_equal(graph.centers, [[0.0, 0.0], [2.0, 0.0], [4.0, 0.0]])
    assert not any(event.salient for event in graph.events)
    assert [x for x, is_new in zip(straight(5.0)[1:], new, strict=True) if is_new] == [2.0, 4.0]
    assert not any(walk(witness, straight(5.0)))  # nothing is new the second time


@every_time
@given(seeds)
def test_every_crossing_over_three_radii_has_an_event_in_its_middle(seed: int) -> None:
    """Where it fails its halves are there: no walk has to be split."""
    rng, witness = np.random.default_rng(seed), make_witness()
    points = np.cumsum(0.4 * np.sign(rng.normal(0.2, 1.0, (300, 2))), axis=0)
    witness.begin(0, points[0])
    for point in points[1:]:
        witness.step(0, point)
    graph, pairs = witness.graph, forward(witness.graph)
    where = {event.id: event.center for event in graph.events}
    long = [(source, target) for source, target in pairs if graph.metric.distance(where[source], where[target]) >= 3.0]
    assert len(long) > 5
    for source, target in long:
        assert any((source, middle) in pairs and (middle, target) in pairs for middle in where)


def test_visits_count_how_often_an_event_was_entered() -> None:
    witness = make_witness()
    walk(witness, straight(5.0))
    walk(witness, [0.0, 0.1, 0.2, 2.0, 2.1, 0.0, 0.0])
    assert witness.graph.visits[:3].tolist() == [3.0, 2.0, 1.0]


@every_time
@given(st.integers(0, 10_000))
def test_landmarks_cover_all_that_was_visited_and_lie_apart(seed: int) -> None:
    rng, witness = np.random.default_rng(seed), make_witness()
    points = np.cumsum(rng.normal(0.0, 0.7, (120, 2)), axis=0)
    witness.begin(0, points[0])
    for point in points[1:]:
        witness.step(0, point)
    graph = witness.graph
    between = np.linalg.norm(graph.centers[:, None] - graph.centers, axis=2)
    np.fill_diagonal(between, np.inf)
    assert between.min() > graph.cover_radius
    assert all(graph.locate(point) != -1 for point in points)


# -- crossings --------------------------------------------------------------------------------------------------------


def test_who_goes_from_one_event_to_another_crosses_in_the_steps_between_their_middles() -> None:
    witness = make_witness()
    walk(witness, [*straight(6.0), 6.5, 8.0])
    found = crossings(witness.graph)
    assert found["e0", "e1"] == (1.0, 0.0, 4.0)
    assert found["e1", "e2"] == (1.0, 0.0, 4.0)
    assert found["e0", "e2"] == (1.0, 0.0, 8.0)
    assert found["e1", "e0"] == (0.0, 1.0, 4.0)  # a guess
    assert found["e0", "e3"] == (1.0, 0.0, 12.0)


def test_only_events_within_the_steps_of_a_walk_are_crossed() -> None:
    witness = make_witness(walk_steps=8)
    walk(witness, straight(10.0))
    graph = witness.graph
    assert ("e0", "e2") in forward(graph)
    assert ("e0", "e3") not in forward(graph)
    assert graph.edges.crossing_steps.max() <= 8


def test_who_stays_for_long_crosses_in_the_steps_from_where_it_was_nearest_of_late() -> None:
    witness = make_witness(walk_steps=10)
    walk(witness, [0.0] * 50 + [0.5, 1.0, 1.5] + [2.0] * 50 + [2.5, 4.0, 6.0])
    found = crossings(witness.graph)
    assert set(forward(witness.graph)) == {("e0", "e1"), ("e1", "e2")}  # through the second it took longer than a walk may
    assert 3.0 <= found["e0", "e1"][2] <= 8.0
    assert 1.0 <= found["e1", "e2"][2] <= 7.0


@every_time
@given(seeds, st.integers(2, 15))
def test_one_event_after_the_other_makes_an_edge_however_long_either_lasted(seed: int, walk_steps: int) -> None:
    rng = np.random.default_rng(seed)
    witness = make_witness(walk_steps=walk_steps)
    points = np.cumsum(rng.uniform(-0.4, 0.4, (300, 2)), axis=0)
    followed, before = set(), None
    for k, point in enumerate(points):
        witness.begin(0, point) if k == 0 else witness.step(0, point)
        here = witness.graph.locate(point)
        if before is not None and here != before:
            followed.add((before, here))
        before = here
    witness.begin(0, np.array([90.0, 0.0]))
    edges = witness.graph.edges
    crossed = {(u, v) for u, v, n in zip(edges.source.tolist(), edges.target.tolist(), edges.forward, strict=True) if n > 0}
    assert followed <= crossed
    assert (edges.crossing_steps[edges.forward > 0] <= walk_steps).all()


def test_a_detour_is_no_way() -> None:
    witness = make_witness()
    walk(witness, [0.0, 2.0, 0.0, 2.0, 4.0])
    # It was in e0 two times: only the way from the second is one.
    found = crossings(witness.graph)
    assert found["e0", "e1"] == (2.0, 1.0, 1.0)
    assert found["e1", "e0"] == (1.0, 2.0, 1.0)


def test_where_an_episode_ends_has_been_crossed_to_as_well() -> None:
    witness = make_witness()
    walk(witness, straight(4.5))
    assert ("e1", "e2") not in forward(witness.graph)  # it might still come nearer
    witness.begin(0, np.array([20.0, 0.0]))
    assert crossings(witness.graph)["e1", "e2"] == (1.0, 0.0, 4.0)
    assert crossings(witness.graph)["e0", "e2"] == (1.0, 0.0, 8.0)
    known = crossings(witness.graph)
    witness.begin(0, np.array([0.0, 0.0]))  # who has not moved has crossed nothing
    assert crossings(witness.graph) == known


def test_nobody_crosses_from_one_episode_into_the_next() -> None:
    witness = make_witness()
    walk(witness, [0.0, 0.5, 0.0])
    walk(witness, [20.0, 20.5, 20.0])
    walk(witness, [40.0, 40.5, 40.0, 42.0, 44.0])
    assert forward(witness.graph) == {("e2", "e3")}
    witness.cut(1)
    walk(witness, [0.0, 0.5])
    assert forward(witness.graph) == {("e2", "e3")}


@pytest.mark.parametrize("n_envs", [1, 4])
def test_steps_are_those_of_one_environment(n_envs: int) -> None:
    witness, xs = make_witness(n_envs), [*straight(12.0), 12.5, 14.0]
    for env in range(n_envs):
        witness.begin(env, np.array([xs[0], 30.0 * env]))
    for x in xs[1:]:
        for env in range(n_envs):
            witness.step(env, np.array([x, 30.0 * env]))
    alone = make_witness()
    walk(alone, xs)
    graph, expected = witness.graph, crossings(alone.graph)
    assert graph.edges.size == n_envs * alone.graph.edges.size > 0
    by_place = {tuple(event.center): event.id for event in graph.events}
    for env in range(n_envs):
        for (source, target), numbers in expected.items():
            places = [float(alone.graph.events[alone.graph.index(id)].center[0]) for id in (source, target)]
            assert crossings(graph)[by_place[places[0], 30.0 * env], by_place[places[1], 30.0 * env]] == numbers


def test_environments_are_watched_apart() -> None:
    witness = make_witness(2)
    witness.begin(0, np.zeros(2))
    witness.begin(1, np.array([50.0, 0.0]))
    for k in range(1, 9):
        witness.step(0, np.array([float(k), 0.0]))
        witness.step(1, np.array([50.0 + k, 0.0]))
    ids = {event.id: event.center[0] for event in witness.graph.events}
    assert forward(witness.graph)
    assert all(abs(ids[source] - ids[target]) < 10.0 for source, target in crossings(witness.graph))


def test_an_event_keeps_only_so_many_edges() -> None:
    rng, witness = np.random.default_rng(0), make_witness(walk_steps=200)
    witness.begin(0, np.zeros(2))
    for point in rng.uniform(0.0, 14.0, (FIT_EVERY, 2)):
        witness.step(0, point)
    graph = witness.graph
    assert len(graph.events) > MAX_DEGREE + 1
    degrees = np.bincount(graph.edges.source, minlength=len(graph.events))
    assert degrees.max() == MAX_DEGREE
    assert (graph.edges.forward + graph.edges.backward > 0).all()


# -- too many events --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n_envs", [1, 3])
def test_there_are_never_more_events_than_there_may_be(n_envs: int) -> None:
    rng, witness = np.random.default_rng(n_envs), make_witness(n_envs, max_events=12)
    points = rng.uniform(0.0, 5.0, (n_envs, 2))
    for env in range(n_envs):
        witness.begin(env, points[env])
    graph, radius = witness.graph, witness.graph.cover_radius
    for _ in range(400):
        points = points + rng.normal(0.3, 1.0, (n_envs, 2))
        for env in range(n_envs):
            witness.step(env, points[env])
            assert graph.locate(points[env]) != -1
            assert len(graph.events) <= 12
            for stays in witness._stays:
                assert all(0 <= stay.event < len(graph.events) for stay in stays)
        edges = graph.edges
        assert (edges.forward + edges.backward > 0).all()
        assert (edges.source != edges.target).all()
        assert (edges.crossing_steps <= 40).all()
    assert graph.cover_radius > radius


def test_an_event_that_is_asked_for_is_made_or_found_where_there_is_no_room() -> None:
    witness = make_witness(max_events=8)
    for k in range(8):
        assert witness.add_event(np.array([2.0 * k, 0.0]), salient=False) == k
    found = witness.add_event(np.array([16.0, 0.0]), salient=True)
    graph = witness.graph
    assert len(graph.events) <= 8
    assert graph.distances(np.array([16.0, 0.0]))[found] <= graph.cover_radius


# -- runs -------------------------------------------------------------------------------------------------------------


def test_a_run_of_a_walk_is_recorded_on_its_edge() -> None:
    witness = make_witness()
    walk(witness, [*straight(6.0), 8.0])
    witness.ended(run("e0", "w1", True, landing="e1", steps=5))
    witness.ended(run("e0", "w1", False, landing="e2", steps=23))
    edges = witness.graph.edges
    row = edges.find(0, 1)
    assert edges.failure_steps[row] == 23.0
    assert (edges.successes[row], edges.success_steps[row], edges.failures[row]) == (1.0, 5.0, 1.0)
    assert edges.landing[row][edges.landing_weight[row] > 0].tolist() == [2]
    assert (edges.successes.sum(), edges.failures.sum()) == (1.0, 1.0)


def test_it_is_learned_how_long_failed_runs_take() -> None:
    expected = []
    for steps in (10, 20):
        witness = make_witness()
        walk(witness, [*straight(6.0), 8.0])
        for _ in range(200):
            witness.ended(run("e0", "w1", True, landing="e1", steps=5))
            witness.ended(run("e0", "w1", False, landing="e0", steps=steps))
        witness.fit()
        model, walks = witness.choice_model.model, witness.choice_model.walks()
        row = witness.graph.edges.find(0, 1)
        assert walks.failed_steps[row] == pytest.approx(steps, rel=0.02)
        # Walks that were not tried take the same share of the time that they have.
        assert model.patience == pytest.approx(steps / timeout(walks.steps[row]), rel=0.05)
        other = int(np.flatnonzero(witness.graph.edges.failures == 0)[0])
        assert walks.failed_steps[other] > 0.0
        expected.append(witness.choice_model.walks().failed_steps[other])
    assert expected[0] < expected[1]


@pytest.mark.parametrize(
    "ended",
    [
        run("e0", "w3", True, landing="e3"),  # nobody crossed that far
        run("", "w1", True, landing="e1"),
        run("e9", "w1", False),
        run("e0", "w9", False),
        run("e1", "w1", True, landing="e1"),
        run("e0", "direct", True, landing="goal", aim=(2.0, 0.0)),
    ],
)
def test_a_run_that_belongs_to_no_edge_makes_none(ended: Run) -> None:
    witness = make_witness(walk_steps=5)
    walk(witness, [*straight(6.0), 8.0])
    before = copy.deepcopy(witness.graph.get_state())
    witness.began(0, np.zeros(2))
    witness.ended(ended)
    np.testing.assert_equal(witness.graph.get_state(), before)


# -- the model of untried walks ---------------------------------------------------------------------------------------


def test_hasty_crossings_are_learned_to_fail() -> None:
    witness = make_witness()
    walk(witness, straight(22.0))  # four steps from landmark to landmark
    graph, model = witness.graph, witness.choice_model.model
    n = len(graph.events)
    for k in range(4):  # one who falls: in a single step
        walk(witness, [2.0 * k, 2.0 * k, 40.0 + 4.0 * k, 42.0 + 4.0 * k])
    slow = [(i, i + 1) for i in range(n - 1) if graph.edges.find(i, i + 1) is not None]
    fast = [
        (int(source), int(target))
        for source, target, steps in zip(graph.edges.source, graph.edges.target, graph.edges.crossing_steps, strict=True)
        if steps <= 3 and abs(graph.centers[source, 0] - graph.centers[target, 0]) > 20.0 and source < n <= target
    ]
    assert len(slow) > 6
    assert len(fast) >= 4
    for source, target in slow[:-1]:
        for _ in range(8):
            witness.ended(run(graph.id(source), f"w{target}", True, landing=graph.id(target), steps=5))
    for source, target in fast[:2]:
        for _ in range(6):
            witness.ended(run(graph.id(source), f"w{target}", False, landing="", steps=20))
    witness.fit()
    kinds = witness.choice_model.kinds()
    hasty = model.is_hasty(kinds)
    assert hasty[[graph.edges.find(*pair) for pair in fast]].all()
    assert not hasty[[graph.edges.find(*pair) for pair in slow]].any()
    success, alike = witness.choice_model.walks().success(EXPECTED), model.success(kinds)
    untried_slow, untried_fast = graph.edges.find(*slow[-1]), graph.edges.find(*fast[-1])
    assert success[untried_slow] > 0.7
    assert alike[untried_fast] < 0.2
    assert success[untried_fast] < 0.2
    assert model.loss[0] > HASTY_LOSS  # they were lost
    assert model.loss[1] == 0.0


def test_failures_of_common_walks_that_end_far_away_are_learned_of() -> None:
    witness = make_witness()
    walk(witness, [*straight(20.0), 22.0])
    for _ in range(10):
        witness.ended(run("e0", "w1", True, landing="e1", steps=5))
        witness.ended(run("e1", "w2", False, landing="e8", steps=30))
        witness.ended(run("e2", "w3", False, landing="e2", steps=30))
    witness.fit()
    assert 0.3 < witness.choice_model.model.loss[1] < 0.6


def test_walks_to_goals_teach_of_ways_that_nobody_went() -> None:
    rates = {}
    for success in (True, False):
        witness = make_witness()
        walk(witness, [*straight(6.0), 8.0])
        for _ in range(40):
            witness.began(0, np.zeros(2))
            witness.ended(run("e0", "direct", success, landing="goal" if success else "", steps=12, aim=(3.0, 0.0)))
        witness.fit()
        model = witness.choice_model.model
        kind = witness.choice_model.kinds()
        unseen = type(kind)(np.array([3.0]), np.zeros(1), np.zeros(1), np.zeros(1), np.zeros((1, 0), dtype=bool))
        rates[success] = float(model.success(unseen)[0])
    assert rates[False] < FIRST_GUESS - 0.1 < FIRST_GUESS + 0.3 < rates[True]


@pytest.mark.parametrize("aim", [(0.8, 0.0), (4.0, 0.0)])  # in the event where they began, and where an edge was let go
def test_walks_to_goals_teach_of_ways_that_somebody_went(aim: tuple[float, float]) -> None:
    witness = make_witness()
    walk(witness, [*straight(6.0), 8.0])
    graph = witness.graph
    graph.edges.keep(np.flatnonzero(graph.edges.target != graph.locate(np.array(aim))))
    for _ in range(40):
        witness.began(0, np.zeros(2))
        witness.ended(run("e0", "direct", False, landing="", steps=12, aim=aim))
    witness.fit()
    samples = witness.get_state()["samples"]
    assert samples[:, 1].tolist() == [1.0] * 40
    assert witness.choice_model.model.success(witness.choice_model.kinds()).max() < FIRST_GUESS - 0.1


def test_the_model_is_fitted_every_so_many_steps() -> None:
    witness = make_witness()
    walk(witness, [*straight(6.0), 8.0])
    witness.ended(run("e0", "w1", True, landing="e1", steps=5))
    model, steps = witness.choice_model.model, witness._n_steps
    assert model.version == 0
    for _ in range(FIT_EVERY - steps - 1):
        witness.step(0, np.zeros(2))
    assert model.version == 0
    witness.step(0, np.zeros(2))
    assert model.version == 2


def test_what_has_aged_teaches_less() -> None:
    rates = []
    for now in (0.0, 20_000.0):
        witness = make_witness()
        walk(witness, [*straight(6.0), 8.0])
        for _ in range(30):
            witness.ended(run("e0", "w1", False, landing="e0", steps=30))
        witness.graph.now = now
        witness.ended(run("e1", "w2", True, landing="e2", steps=5))
        witness.fit()
        rates.append(float(witness.choice_model.model.success(witness.choice_model.kinds()).mean()))
    assert rates[0] + 0.1 < rates[1]


# -- saving -----------------------------------------------------------------------------------------------------------


def test_a_restored_witness_goes_on_where_it_was() -> None:
    rng, witness = np.random.default_rng(5), make_witness(2)
    points = np.cumsum(rng.normal(0.2, 0.6, (300, 2, 2)), axis=0)
    other = make_witness(2)
    for watcher in (witness, other):
        for env in range(2):
            watcher.begin(env, points[0, env])
        for now in points[1:150]:
            for env in range(2):
                watcher.step(env, now[env])
        watcher.began(1, np.ones(2))
        watcher.ended(run("e0", "direct", True, landing="goal", aim=(3.0, 0.0)))
    restored = make_witness(2)
    restored.graph.set_state(copy.deepcopy(witness.graph.get_state()))
    restored.set_state(copy.deepcopy(witness.get_state()))
    np.testing.assert_equal(restored.get_state(), witness.get_state())
    for watcher in (restored, other):
        for now in points[150:]:
            for env in range(2):
                watcher.step(env, now[env])
        watcher.fit()
    np.testing.assert_equal(restored.graph.get_state(), other.graph.get_state())
    np.testing.assert_equal(restored.get_state(), other.get_state())
    np.testing.assert_equal(restored.choice_model.model.get_state(), other.choice_model.model.get_state())
