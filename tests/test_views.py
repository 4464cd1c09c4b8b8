import numpy as np
import pytest

from sb3_skillgraph.options.views import VIEWS, ScaledView, View, egocentric_view, relative_view


def rows(n: int, dim: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(n, dim)).astype(np.float32)


def test_relative_view_shows_all_and_the_goal_from_where_the_agent_stands() -> None:
    observation, achieved, goal = rows(5, 4, 0), rows(5, 3, 1), rows(5, 3, 2)
    seen = relative_view(observation, achieved, goal)
    assert seen.shape == (5, 10)
    np.testing.assert_array_equal(seen[:, :4], observation)
    np.testing.assert_array_equal(seen[:, 4:7], achieved)
    np.testing.assert_array_equal(seen[:, 7:], goal - achieved)


def test_egocentric_view_drops_position() -> None:
    achieved, goal, rest = rows(5, 2, 1), rows(5, 2, 2), rows(5, 3, 3)
    shift = np.array([[7.0, -3.0]], dtype=np.float32)
    here = egocentric_view(np.concatenate([achieved, rest], axis=1), achieved, goal)
    elsewhere = egocentric_view(np.concatenate([achieved + shift, rest], axis=1), achieved + shift, goal + shift)
    assert here.shape == (5, 5)
    np.testing.assert_array_equal(here[:, :3], rest)
    np.testing.assert_allclose(here, elsewhere, atol=1e-5)


@pytest.mark.parametrize("name", sorted(VIEWS))
@pytest.mark.parametrize("unit", [0.05, 4.0])
def test_scaled_view_measures_goal_space_in_units(name: str, unit: float) -> None:
    rest, achieved, goal = rows(6, 3, 0), rows(6, 2, 1), rows(6, 2, 2)
    observation = np.concatenate([achieved, rest], axis=1)
    seen = ScaledView(VIEWS[name], unit)(observation, achieved, goal)
    assert seen.dtype == np.float32
    assert seen.flags.c_contiguous
    np.testing.assert_allclose(seen[:, -2:], (goal - achieved) / unit, rtol=1e-4, atol=1e-5)
    if name == "relative":
        np.testing.assert_allclose(seen[:, 5:7], achieved / unit, rtol=1e-5)
        np.testing.assert_array_equal(seen[:, :5], observation)  # what is not goal space keeps its units


@pytest.mark.parametrize("view", [relative_view, egocentric_view, lambda o, a, g: np.concatenate([o, o, g], axis=1)])
def test_scaled_view_knows_its_length(view: View) -> None:
    scaled = ScaledView(view, 0.5)
    assert scaled.dim(6, 2) == scaled(rows(3, 6, 0), rows(3, 2, 1), rows(3, 2, 2)).shape[1]


def test_scaled_view_is_float32_whatever_comes_in() -> None:
    seen = ScaledView(relative_view, 2.0)(rows(2, 4, 0).astype(np.float64), np.ones((2, 2)), np.zeros((2, 2)))
    assert seen.dtype == np.float32
    np.testing.assert_allclose(seen[:, -2:], -0.5)
