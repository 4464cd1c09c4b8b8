"""What is expected of walks that nobody has tried: the rates and steps of their kind."""

import copy

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_skillgraph.walk_model import ENOUGH_LONG, FIRST_GUESS, HASTY, HASTY_LOSS, Kind, WalkModel


def kinds(*rows: tuple[float, float, float, float]) -> Kind:
    """Rows of distance, steps, forward and backward."""
    return Kind(*np.array(rows, dtype=np.float64).reshape(-1, 4).T, np.zeros((len(rows), 0), dtype=bool))


#: A short walk that was seen, a long one, one whose reverse was seen, and one that nobody has seen.
SHORT, LONG, BACK, UNSEEN = (2.0, 10.0, 1.0, 0.0), (8.0, 40.0, 1.0, 0.0), (2.0, 10.0, 0.0, 1.0), (2.0, 0.0, 0.0, 0.0)


def rows(nearest: float) -> st.SearchStrategy[list[tuple[float, float, int, int]]]:
    row = st.tuples(st.floats(nearest, 50.0), st.floats(0.0, 60.0), st.integers(0, 30), st.integers(0, 30))
    return st.lists(row, min_size=1, max_size=12)


every_time = settings(derandomize=True, deadline=None, max_examples=40, database=None)


def fitted(*runs: tuple[tuple[float, float, float, float], float, float]) -> WalkModel:
    """A model that has seen runs: what was known of the walk, successes and failures; successes take the steps expected."""
    model = WalkModel()
    kind = kinds(*(run[0] for run in runs))
    successes, failures = np.array([run[1:] for run in runs]).T
    model.fit(kind, successes, failures, successes * kind.steps)
    return model


def success(model: WalkModel, row: tuple[float, float, float, float]) -> float:
    return float(model.success(kinds(row))[0])


def test_before_any_run_all_walks_are_those_of_a_hardly_trained_policy() -> None:
    model = WalkModel()
    np.testing.assert_allclose(model.success(kinds(SHORT, LONG, BACK, UNSEEN)), FIRST_GUESS)
    assert not model.is_hasty(kinds(SHORT, LONG, (8.0, 1.0, 1.0, 0.0))).any()
    np.testing.assert_array_equal(model.loss, [HASTY_LOSS, 0.0])


def test_what_nobody_has_seen_change_is_not_believed_to_change() -> None:
    """A walk that would fetch a key is guessed by a prior of its own, for each of what has to match."""
    model = WalkModel(n_matched=2)

    def rate(forward: float, *changes: bool) -> float:
        kind = Kind(*(np.array([x]) for x in (4.0, 20.0, forward, 1.0)), np.array([changes]))
        return float(model.success(kind)[0])

    known = Kind(*np.array([[4.0, 20.0, 5.0, 5.0]] * 20).T, np.zeros((20, 2), dtype=bool))
    model.fit(known, np.full(20, 5.0), np.zeros(20), np.full(20, 100.0))
    same = rate(0.0, False, False)
    assert rate(0.0, True, False) < 0.5 * same
    assert rate(0.0, False, True) < 0.5 * same
    assert rate(1.0, True, False) > 0.9 * rate(1.0, False, False)  # it was seen


def test_without_runs_nothing_is_learned() -> None:
    model = WalkModel()
    before = copy.deepcopy(model.get_state())
    model.fit(kinds(SHORT, LONG), np.zeros(2), np.zeros(2), np.zeros(2))
    model.fit(kinds(), np.zeros(0), np.zeros(0), np.zeros(0))
    np.testing.assert_equal(model.get_state(), before)


def test_walks_like_those_that_succeed_are_expected_to() -> None:
    model = fitted((SHORT, 60.0, 1.0), (LONG, 1.0, 60.0))
    assert success(model, (2.2, 11.0, 1.0, 0.0)) > 0.85
    assert success(model, (7.5, 37.0, 1.0, 0.0)) < 0.2


def test_few_runs_change_little_and_many_change_much() -> None:
    few, many = fitted((SHORT, 1.0, 0.0)), fitted((SHORT, 200.0, 0.0))
    assert FIRST_GUESS < success(few, SHORT) < 0.5
    assert success(many, SHORT) > 0.95
    assert success(fitted((SHORT, 0.0, 200.0)), SHORT) < 0.05


def test_ways_seen_only_backward_and_ways_never_seen_have_levels_of_their_own() -> None:
    model = fitted((SHORT, 50.0, 5.0), (BACK, 5.0, 50.0), (UNSEEN, 20.0, 20.0))
    forward, backward, unseen = success(model, SHORT), success(model, BACK), success(model, UNSEEN)
    assert backward + 0.2 < unseen < forward - 0.2


def test_a_crossing_that_was_faster_than_anybody_walks_is_distrusted() -> None:
    model = fitted((SHORT, 40.0, 4.0), (LONG, 30.0, 10.0))
    lucky, slow = (8.0, 2.0, 1.0, 0.0), (8.0, 38.0, 1.0, 0.0)
    assert model.fastest == pytest.approx(5.0)
    assert model.is_hasty(kinds(lucky, slow, SHORT, UNSEEN)).tolist() == [True, False, False, False]
    assert success(model, lucky) < 0.5 * success(model, slow)


def test_haste_is_measured_beside_the_fastest_walks() -> None:
    kind = kinds((2.0, 5.0, 1.0, 0.0), (2.0, 1.0, 0.0, 1.0), (2.0, 1.0, 0.0, 0.0), (2.0, 40.0, 1.0, 0.0))
    np.testing.assert_allclose(kind.haste(5.0), [np.log(2.0), np.log(10.0), 0.0, 0.0])
    model = WalkModel()
    model.fastest = 5.0
    border = 5.0 * 2.0 / HASTY
    assert model.is_hasty(kinds((2.0, 0.99 * border, 1.0, 0.0), (2.0, 1.01 * border, 1.0, 0.0))).tolist() == [True, False]


def test_speed_is_that_of_long_walks_without_the_radius_that_they_are_spared() -> None:
    # Walkers of 5 steps a radius, whose runs end one radius early: a short walk looks twice as fast as it is.
    short = [((2.0, 10.0, 1.0, 0.0), 4.0, 0.0, 5.0)] * 30
    long = [((6.0, 30.0, 1.0, 0.0), 4.0, 0.0, 25.0)]
    for n_long, fastest in ((ENOUGH_LONG - 1, 2.5), (ENOUGH_LONG, 5.0)):
        runs = short + n_long * long
        kind = kinds(*(row for row, *_ in runs))
        successes, failures, steps = np.array([rest for _, *rest in runs]).T
        model = WalkModel()
        model.fit(kind, successes, failures, successes * steps)
        assert model.fastest == pytest.approx(fastest)


def test_hasty_walks_are_distrusted_although_none_has_been_tried_yet() -> None:
    model = fitted((SHORT, 100.0, 0.0))
    assert success(model, (2.0, 1.0, 1.0, 0.0)) < 0.6 < 0.9 < success(model, SHORT)


def test_hasty_walks_that_come_off_are_trusted_after_all() -> None:
    lucky = (8.0, 2.0, 1.0, 0.0)
    tried = fitted((SHORT, 40.0, 4.0), (LONG, 30.0, 10.0), (lucky, 60.0, 0.0))
    assert success(tried, lucky) > 0.8


def test_the_steps_of_walks_are_learned() -> None:
    model, distances = WalkModel(), np.array([1.0, 2.0, 4.0, 6.0])
    crossing = 12.0 * distances  # those who explored wandered about
    kind = Kind(distances, crossing, np.ones(4), np.zeros(4), np.zeros((4, 0), dtype=bool))
    model.fit(kind, np.full(4, 50.0), np.zeros(4), 50.0 * (3.0 + 4.0 * distances))
    np.testing.assert_allclose(model.steps(kind), 3.0 + 4.0 * distances, rtol=0.02)
    assert 4.0 < model.steps_per_radius < 6.0
    assert model.steps(kinds((10.0, 0.0, 0.0, 0.0)))[0] == pytest.approx(10.0 * model.steps_per_radius)
    assert model.steps(kinds((0.0, 0.0, 0.0, 0.0)))[0] == 1.0


def test_failed_runs_teach_nothing_of_steps() -> None:
    model = fitted((SHORT, 0.0, 20.0), (LONG, 0.0, 20.0))
    fresh = WalkModel()
    np.testing.assert_array_equal(model.pace, fresh.pace)
    assert (model.steps_per_radius, model.fastest) == (fresh.steps_per_radius, fresh.fastest)


def test_walks_that_never_failed_or_never_succeeded_can_be_learned_from() -> None:
    assert success(fitted((SHORT, 5.0, 0.0)), SHORT) > FIRST_GUESS
    assert success(fitted((SHORT, 0.0, 5.0)), SHORT) < FIRST_GUESS


def test_a_run_of_weight_two_is_two_runs() -> None:
    once, twice = fitted((SHORT, 6.0, 2.0), (LONG, 2.0, 6.0)), fitted(
        (SHORT, 3.0, 1.0), (SHORT, 3.0, 1.0), (LONG, 1.0, 3.0), (LONG, 1.0, 3.0)
    )  # fmt: skip
    np.testing.assert_allclose(once.coefficients, twice.coefficients, atol=1e-3)
    np.testing.assert_allclose(once.pace, twice.pace)


def test_every_fit_is_a_new_version() -> None:
    model = WalkModel()
    for version in (1, 2, 3):
        model.fit(kinds(SHORT), np.ones(1), np.ones(1), np.full(1, 10.0))
        assert model.version == version


@every_time
@given(rows(0.05), rows(0.0), st.integers(0, 10_000))
def test_rates_are_probabilities_and_steps_are_finite_whatever_was_learned(
    known: list[tuple[float, float, int, int]], asked: list[tuple[float, float, int, int]], seed: int
) -> None:
    rng = np.random.default_rng(seed)
    model, kind = WalkModel(), kinds(*known)
    for _ in range(2):
        successes, failures = rng.integers(0, 20, (2, len(known))).astype(np.float64)
        model.fit(kind, successes, failures, successes * rng.uniform(1.0, 60.0, len(known)))
        other = kinds(*asked)
        assert ((model.success(other) > 0.0) & (model.success(other) < 1.0)).all()
        assert (np.isfinite(model.steps(other)) & (model.steps(other) >= 1.0)).all()


def test_a_fit_is_a_function_of_the_runs_and_of_what_was_known_before() -> None:
    runs = [(SHORT, 30.0, 5.0), (LONG, 3.0, 30.0), (BACK, 2.0, 2.0)]
    np.testing.assert_equal(fitted(*runs).get_state(), fitted(*runs).get_state())


def test_a_restored_model_expects_the_same() -> None:
    model = fitted((SHORT, 30.0, 5.0), (LONG, 3.0, 30.0), (BACK, 2.0, 2.0))
    restored = WalkModel()
    restored.set_state(copy.deepcopy(model.get_state()))
    asked = kinds(SHORT, LONG, BACK, UNSEEN, (8.0, 2.0, 1.0, 0.0))
    np.testing.assert_array_equal(restored.success(asked), model.success(asked))
    np.testing.assert_array_equal(restored.steps(asked), model.steps(asked))
    np.testing.assert_array_equal(restored.is_hasty(asked), model.is_hasty(asked))
    np.testing.assert_array_equal(restored.loss, model.loss)


def test_a_state_is_no_view_of_the_model() -> None:
    model, restored = fitted((SHORT, 30.0, 5.0), (LONG, 3.0, 30.0)), WalkModel()
    state = model.get_state()
    restored.set_state(state)
    before = copy.deepcopy(state)
    for changed in (model, restored):
        for array in (changed.loss, changed.pace, changed.coefficients, changed.mean, changed.scale):
            array += 0.5
        np.testing.assert_equal(state, before)
