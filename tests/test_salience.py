import copy

import numpy as np
import pytest
from builders import World, profile
from hypothesis import given
from hypothesis import strategies as st

from sb3_skillgraph.salience.discovery import EventDiscovery
from sb3_skillgraph.salience.proposals import FrontierSalience, RandomSalience
from sb3_skillgraph.visited import VisitedStates

K, R = 30, 10


class Scripted:
    """Salience that proposes what it is told to, then nothing."""

    def __init__(self, *centers: tuple[float, float]) -> None:
        self.centers = list(centers)
        self.n_asked = 0

    def propose(self, rng: np.random.Generator) -> np.ndarray | None:
        self.n_asked += 1
        return np.array(self.centers.pop(0)) if self.centers else None


def make_discovery(
    world: World, *centers: tuple[float, float], pair: int = 2, n_tries: int = 1, max_unconnected: int | None = None
) -> EventDiscovery:
    return EventDiscovery(world.graph, Scripted(*centers), 1.0, K, R, pair, n_tries, max_unconnected)


RNG = np.random.default_rng(0)

# -- proposals --------------------------------------------------------------------------------------------------------


@given(st.integers(0, 30), st.integers(2, 15))
@profile(25)
def test_frontier_proposes_visited_states_within_reach_of_an_event(seed: int, reach: int) -> None:
    rng = np.random.default_rng(seed)
    visited = VisitedStates(2, 0.5)
    visited.set_events(np.zeros((1, 2)), np.ones(1))
    for _ in range(6):
        heading, point = rng.normal(size=2), np.zeros(2)
        for t in range(40):
            visited.record(0, t, point.astype(np.float32), done=t == 39)
            point = point + 0.4 * heading / np.linalg.norm(heading) + rng.normal(0, 0.2, 2)
    salience = FrontierSalience(visited, margin=2.0, reach=reach)
    for _ in range(20):
        proposed = salience.propose(rng)
        assert proposed is not None
        assert (np.abs(visited.points - proposed).sum(axis=1) < 1e-6).any()
        assert min(visited.events_before(proposed, 0.0).values()) <= reach


def test_frontier_is_drawn_to_the_edge_and_grows_the_box() -> None:
    visited = VisitedStates(2, 0.5)
    for t in range(21):
        visited.record(0, t, np.array([t, 0.0], dtype=np.float32))
    salience = FrontierSalience(visited, margin=3.0, reach=1000)
    rng = np.random.default_rng(0)
    samples = np.stack([salience.sample(rng) for _ in range(500)])
    assert (samples.min(axis=0) < [-2.5, -2.5]).all()
    assert (samples.max(axis=0) > [22.5, 2.5]).all()
    assert (samples >= [-3.0, -3.0]).all()
    assert (samples <= [23.0, 3.0]).all()


def test_frontier_proposes_nothing_before_anything_was_visited() -> None:
    assert FrontierSalience(VisitedStates(2, 0.5), 1.0, 10).propose(RNG) is None


def test_rrt_asks_the_oracle() -> None:
    asked = []

    def sample_free(rng: np.random.Generator) -> np.ndarray:
        asked.append(rng)
        return np.array([7, 8], dtype=np.float32)

    rng = np.random.default_rng(0)
    proposed = RandomSalience(sample_free).propose(rng)
    assert asked == [rng]
    assert proposed is not None
    assert proposed.dtype == np.float64
    assert proposed.tolist() == [7.0, 8.0]


# -- rejection (A.1.1) ------------------------------------------------------------------------------------------------


def test_redundant_are_points_in_an_event_or_in_an_initiation_set() -> None:
    world = World()
    events = [world.add_event(0.0, 0.0), world.add_event(20.0, 0.0)]
    world.add_option(events[1], (10.0, 0.0), start_radius=2.0)
    discovery = make_discovery(world)
    assert discovery.redundant(np.array([0.9, 0.0]))  # (a)
    assert discovery.redundant(np.array([11.5, 0.0]))  # (b)
    assert not discovery.redundant(np.array([1.1, 0.0]))
    assert not discovery.redundant(np.array([5.0, 0.0]))


def test_a_gestating_option_rejects_nothing() -> None:
    world = World()
    chain = world.chaining.open_chain(world.add_event(0.0, 0.0), world.add_event(20.0, 0.0))
    option = world.chaining.options[chain.options[0]]
    option.initiation.add_success(np.array([[10.0, 0.0]]))
    option.initiation.refit(force=True)
    assert not make_discovery(world).redundant(np.array([10.0, 0.0]))


def test_accepted_events_join_the_graph_and_redundant_ones_do_not() -> None:
    world = World()
    world.add_event(0.0, 0.0)
    discovery = make_discovery(world, (0.5, 0.0), (5.0, 0.0), (5.5, 0.0), (9.0, 0.0), pair=2, n_tries=2)
    added = discovery.attempt(3, RNG)
    assert [event.id for event in added] == ["e1", "e2"]
    assert [event.center.tolist() for event in added] == [[5.0, 0.0], [9.0, 0.0]]
    assert [event.radius for event in added] == [1.0, 1.0]
    assert list(world.graph.events) == ["e0", "e1", "e2"]
    assert (discovery.n_rejected, discovery.newest) == (2, "e2")


@pytest.mark.parametrize(("pair", "n_tries", "n_asked"), [(2, 1, 2), (1, 20, 20), (2, 3, 6)])
def test_an_attempt_draws_so_many_proposals(pair: int, n_tries: int, n_asked: int) -> None:
    world = World()
    world.add_event(0.0, 0.0)
    discovery = make_discovery(world, *[(0.0, 0.0)] * 100, pair=pair, n_tries=n_tries)
    assert discovery.attempt(0, RNG) == []
    assert isinstance(discovery.salience, Scripted)
    assert discovery.salience.n_asked == discovery.n_rejected == n_asked


# -- when (A.1.2) -----------------------------------------------------------------------------------------------------


def first_due(discovery: EventDiscovery, connected: set[str], start: int) -> int:
    return next(episode for episode in range(start, start + 200) if discovery.due(episode, connected))


def discovered(*centers: tuple[float, float], episode: int) -> EventDiscovery:
    """A discovery that has just made an attempt, with one event there before."""
    world = World()
    world.add_event(0.0, 0.0)
    discovery = make_discovery(world, *centers)
    discovery.newest = "e0"
    discovery.attempt(episode, RNG)
    return discovery


def test_an_attempt_is_due_at_once_when_the_newest_event_has_been_joined() -> None:
    discovery = discovered((5.0, 0.0), (9.0, 0.0), episode=7)
    assert not discovery.due(7, {"e0"})
    assert not discovery.due(7, {"e0", "e1"})
    assert discovery.due(7, {"e0", "e2"})
    assert discovery.due(7, {"e0", "e1", "e2"})


@pytest.mark.parametrize("second", [(9.0, 0.0), (5.5, 0.0)])
def test_an_attempt_is_due_k_episodes_after_an_acceptance(second: tuple[float, float]) -> None:
    discovery = discovered((5.0, 0.0), second, episode=7)  # one event of the pair is enough
    assert first_due(discovery, {"e0"}, 7) == 7 + K


def test_an_attempt_is_due_r_episodes_after_both_were_rejected() -> None:
    discovery = discovered((0.5, 0.0), (0.0, 0.5), episode=7)
    assert first_due(discovery, {"e0"}, 7) == 7 + R
    discovery.attempt(7 + R, RNG)  # nothing proposed at all: the same
    assert first_due(discovery, {"e0"}, 7 + R) == 7 + 2 * R


def test_an_acceptance_ends_the_waiting_after_a_rejection() -> None:
    discovery = discovered((0.5, 0.0), (0.0, 0.5), (5.0, 0.0), (9.0, 0.0), episode=7)
    discovery.attempt(17, RNG)
    assert first_due(discovery, {"e0"}, 17) == 17 + K


@pytest.mark.parametrize(("limit", "due"), [(None, True), (3, True), (2, False), (1, False)])
def test_no_attempt_while_too_many_events_are_unconnected(limit: int | None, due: bool) -> None:
    world = World()
    for x in (0.0, 5.0, 9.0):
        world.add_event(x, 0.0)
    assert make_discovery(world, max_unconnected=limit).due(1000, {"e0"}) == due


def test_the_first_event_is_the_newest_until_another_is_accepted() -> None:
    world = World()
    discovery = make_discovery(world)
    assert discovery.add(np.zeros(2)).id == "e0"
    discovery.newest = "e0"
    assert discovery.due(0, {"e0"})


def test_state_round_trip() -> None:
    for centers in (((5.0, 0.0), (9.0, 0.0)), ((0.5, 0.0), (0.0, 0.5))):
        discovery = discovered(*centers, episode=7)
        restored = make_discovery(World())
        restored.graph = discovery.graph
        restored.set_state(copy.deepcopy(discovery.get_state()))
        for connected in ({"e0"}, {"e0", "e2"}):
            for episode in range(7, 60):
                assert restored.due(episode, connected) == discovery.due(episode, connected)
        assert restored.n_rejected == discovery.n_rejected
