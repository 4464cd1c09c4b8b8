import copy

import numpy as np
import pytest
from builders import profile
from hypothesis import given
from hypothesis import strategies as st
from sklearn.svm import SVC, OneClassSVM

from sb3_skillgraph.options.initiation import N_FAILURES, N_SUCCESSES, POINTS_PER_SUCCESS, InitiationSet

RADIUS = 1.0


def path(start: list[float], end: list[float], n: int = 20, noise: float = 0.0, seed: int = 0) -> np.ndarray:
    way = np.linspace(start, end, n)
    return way + np.random.default_rng(seed).normal(0.0, noise, way.shape)


def corridor(n_successes: int = 10, length: float = 5.0) -> InitiationSet:
    initiation = InitiationSet(RADIUS)
    for seed in range(n_successes):
        initiation.add_success(path([0.0, 0.0], [length, 0.0], noise=0.2, seed=seed))
    return initiation


def with_failures() -> InitiationSet:
    """A corridor, and a branch into it from (0, 3) that worked twice and failed often."""
    initiation = corridor()
    for seed in range(2):
        initiation.add_success(path([0.0, 3.0], [5.0, 0.0], noise=0.1, seed=seed))
    for seed in range(8):
        initiation.add_failure(np.array([0.0, 3.0]) + np.random.default_rng(seed).normal(0.0, 0.1, 2))
    initiation.refit(force=True)
    return initiation


def grid(low: float = -3.0, high: float = 8.0, n: int = 40) -> np.ndarray:
    axis = np.linspace(low, high, n)
    return np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)


def test_empty_before_the_first_fit() -> None:
    initiation = InitiationSet(RADIUS)
    initiation.add_failure(np.zeros(2))
    assert not initiation.refit(force=True)  # failures alone describe no place
    initiation.add_success(path([0.0, 0.0], [1.0, 0.0]))
    assert not initiation.optimistic_boundaries
    assert not initiation.optimistic(grid()).any()
    assert not initiation.pessimistic(grid()).any()
    assert initiation.core is None
    assert initiation.refit()
    assert initiation.optimistic_boundaries
    assert initiation.optimistic(grid()).any()


def test_numpy_evaluation_equals_scikit_learns() -> None:
    initiation = with_failures()
    positives = np.concatenate(initiation.successes)
    negatives = np.stack(initiation.failures)
    gamma = initiation.optimistic_boundaries[0].gamma
    assert gamma == pytest.approx(1.0 / (2 * max(positives.var(), 0.25 * RADIUS**2)))
    labels = np.repeat([1, 0], [len(positives), len(negatives)])
    split = SVC(gamma=gamma, class_weight="balanced").fit(np.concatenate([positives, negatives]), labels)
    assert 0 < (split.decision_function(positives) <= 0).sum() < 10  # the core is fitted to the others
    core = OneClassSVM(nu=0.1, gamma=gamma).fit(positives[split.decision_function(positives) > 0])
    points = grid(-1.0, 6.0)
    whole_decision = OneClassSVM(nu=0.01, gamma=gamma).fit(positives).decision_function(points)
    split_decision, core_decision = split.decision_function(points), core.decision_function(points)
    clear = np.min(np.abs([whole_decision, split_decision, core_decision]), axis=0) > 2e-3  # off the boundaries
    assert clear.mean() > 0.9
    expected = (whole_decision > 0) & (split_decision > 0)
    assert 0.05 < expected.mean() < 0.95
    np.testing.assert_array_equal(initiation.optimistic(points)[clear], expected[clear])
    np.testing.assert_array_equal(initiation.pessimistic(points)[clear], (expected & (core_decision > 0))[clear])


@given(
    st.lists(st.tuples(*[st.floats(-5, 5)] * 4), min_size=1, max_size=8),
    st.integers(1, 40),
    st.sampled_from([0.05, 1.0, 4.0]),
)
@profile(40)
def test_optimistic_contains_nearly_all_successes(ends: list[tuple[float, ...]], n: int, radius: float) -> None:
    initiation = InitiationSet(radius)
    for x0, y0, x1, y1 in ends:
        initiation.add_success(path([x0, y0], [x1, y1], n))
    initiation.refit(force=True)
    assert initiation.optimistic(np.concatenate(initiation.successes)).mean() >= 0.9
    assert initiation.core is not None
    assert initiation.pessimistic(initiation.core[None])[0]


def test_far_away_is_outside() -> None:
    initiation = corridor()
    initiation.refit(force=True)
    far = np.array([[20.0, 0.0], [2.0, 9.0], [-9.0, 0.0]])
    assert not initiation.optimistic(far).any()


def test_failures_carve() -> None:
    initiation = corridor()
    for seed in range(2):
        initiation.add_success(path([0.0, 3.0], [5.0, 0.0], noise=0.1, seed=seed))
    initiation.refit(force=True)
    branch, points = np.array([[0.0, 3.0], [0.1, 2.9]]), grid(-1.0, 6.0)
    corridor_points = np.stack([np.linspace(0.0, 5.0, 8), np.zeros(8)], axis=1)
    before = initiation.optimistic(points)
    assert initiation.optimistic(branch).all()
    for seed in range(8):
        initiation.add_failure(np.array([0.0, 3.0]) + np.random.default_rng(seed).normal(0.0, 0.1, 2))
    initiation.refit(force=True)
    assert not initiation.optimistic(branch).any()
    assert initiation.optimistic(corridor_points).all()
    assert not (initiation.optimistic(points) & ~before).any()  # failures never add


def test_successes_outvote_failures_at_the_same_place() -> None:
    initiation = corridor(n_successes=2)
    spot = np.array([0.0, 3.0])
    for _ in range(3):
        initiation.add_failure(spot)
    initiation.refit(force=True)
    assert not initiation.optimistic(spot[None])[0]
    for seed in range(2):
        initiation.add_success(path([0.0, 3.0], [5.0, 0.0], noise=0.05, seed=seed))
    initiation.refit(force=True)
    assert not initiation.optimistic(spot[None])[0]  # three against two
    initiation.add_success(path([0.0, 3.0], [5.0, 0.0], noise=0.05, seed=2))
    initiation.refit(force=True)
    assert initiation.optimistic(spot[None])[0]  # three against three


@pytest.mark.parametrize("initiation", [corridor(), with_failures()], ids=["successes", "failures"])
def test_pessimistic_is_the_core_of_optimistic(initiation: InitiationSet) -> None:
    initiation.refit(force=True)
    points = grid(-1.0, 6.0, 80)
    optimistic, pessimistic = initiation.optimistic(points), initiation.pessimistic(points)
    assert pessimistic.any()
    assert optimistic[pessimistic].all()  # where an option may be aimed at, it can start
    assert pessimistic.sum() < optimistic.sum()
    assert initiation.core is not None
    assert initiation.optimistic(initiation.core[None])[0]


def test_memory_is_bounded() -> None:
    initiation = InitiationSet(RADIUS)
    for k in range(3 * N_SUCCESSES):
        initiation.add_success(path([k, 0.0], [k, 1.0], n=500))
        initiation.add_failure(np.array([k, 5.0]))
    assert len(initiation.successes) == N_SUCCESSES
    assert len(initiation.failures) == N_FAILURES
    assert max(len(success) for success in initiation.successes) <= POINTS_PER_SUCCESS
    assert initiation.successes[-1][0].tolist() == [3 * N_SUCCESSES - 1, 0.0]  # the newest are kept,
    assert initiation.successes[-1][-1].tolist() == [3 * N_SUCCESSES - 1, 1.0]  # from start to end
    initiation.refit(force=True)
    assert not initiation.optimistic(np.array([[0.0, 0.0]]))[0]  # long forgotten


def test_refit_waits_for_news() -> None:
    initiation = corridor(20)
    assert initiation.refit()
    fitted = initiation.optimistic_boundaries[0]
    for k in range(3):
        initiation.add_failure(np.full(2, 9.0))
        assert not initiation.refit(), k
    assert initiation.optimistic_boundaries[0] is fitted
    initiation.add_failure(np.full(2, 9.0))
    assert initiation.refit()  # a fifth of what is known
    assert not initiation.refit()
    assert not initiation.refit(force=True)  # nothing at all is new
    initiation.add_failure(np.full(2, 9.0))
    assert initiation.refit(force=True)


def test_one_short_success_describes_a_place() -> None:
    initiation = InitiationSet(RADIUS)
    initiation.add_success(np.array([[2.0, 2.0]]))
    initiation.refit(force=True)
    assert initiation.optimistic(np.array([[2.0, 2.0], [2.02, 2.0]])).all()
    assert not initiation.optimistic(np.array([[2.0, 6.0]])).any()


@pytest.mark.parametrize("fitted", [False, True])
def test_state_round_trip(fitted: bool) -> None:
    initiation = with_failures() if fitted else InitiationSet(RADIUS)
    initiation.add_success(path([0.0, 0.0], [0.0, 4.0]))
    restored = InitiationSet(RADIUS)
    restored.set_state(copy.deepcopy(initiation.get_state()))
    points = grid()
    for _ in range(2):
        np.testing.assert_array_equal(restored.optimistic(points), initiation.optimistic(points))
        np.testing.assert_array_equal(restored.pessimistic(points), initiation.pessimistic(points))
        assert (restored.core is None) == (initiation.core is None)
        if initiation.core is not None:
            np.testing.assert_array_equal(restored.core, initiation.core)
        for either in (initiation, restored):
            either.add_failure(np.array([0.0, 3.0]))
        assert restored.refit() == initiation.refit()
