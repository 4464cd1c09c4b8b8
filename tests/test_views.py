import numpy as np
import pytest

from sb3_skillgraph.envs.bodies import body_view, placed_body_view
from sb3_skillgraph.metric import Ball
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


def turned(vectors: np.ndarray, angle: float) -> np.ndarray:
    cosine, sine = np.cos(angle), np.sin(angle)
    return vectors @ np.array([[cosine, sine], [-sine, cosine]])


def turned_body(observation: np.ndarray, n_joints: int, angle: float) -> np.ndarray:
    """The same body after the world has been turned about the vertical."""
    observation = observation.copy()
    w, x, y, z = observation[:, 1:5].T
    cosine, sine = np.cos(0.5 * angle), np.sin(0.5 * angle)
    observation[:, 1:5] = np.stack(
        [cosine * w - sine * z, cosine * x - sine * y, cosine * y + sine * x, cosine * z + sine * w], axis=1
    )
    velocity = slice(5 + n_joints, 7 + n_joints)
    observation[:, velocity] = turned(observation[:, velocity], angle)
    return observation


@pytest.mark.parametrize("angle", [0.3, 2.0, -1.2, np.pi])
@pytest.mark.parametrize("n_joints", [0, 8])
def test_body_view_is_the_same_in_every_place_and_direction(n_joints: int, angle: float) -> None:
    observation, achieved, goal = (rows(20, dim, dim).astype(np.float64) for dim in (11 + 2 * n_joints, 2, 2))
    observation[:, 1:5] /= np.linalg.norm(observation[:, 1:5], axis=1, keepdims=True)
    here = body_view(observation, achieved, goal)
    assert here.shape == (20, 13 + 2 * n_joints)
    shift = np.array([7.0, -3.0])
    elsewhere = [turned(points, angle) + shift for points in (achieved, goal)]
    np.testing.assert_allclose(body_view(turned_body(observation, n_joints, angle), *elsewhere), here, atol=1e-6)


def test_body_view_shows_where_the_goal_lies_and_which_way_is_up() -> None:
    upright, on_its_back = [0.5, 1.0, 0.0, 0.0, 0.0], [0.5, 0.0, 1.0, 0.0, 0.0]
    to_the_left = [0.5, np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)]  # it faces along y
    observation = np.array([[*pose, 2.0, 0.0, 0.0, 0.0, 0.0, 0.0] for pose in (upright, on_its_back, to_the_left)])
    seen = body_view(observation, np.zeros((3, 2)), np.array([[3.0, 4.0]] * 3))
    np.testing.assert_allclose(seen[:, 1:4], [[0, 0, 1], [0, 0, -1], [0, 0, 1]], atol=1e-9)
    np.testing.assert_allclose(seen[:, 4:6], [[2, 0], [2, 0], [0, -2]], atol=1e-9)  # velocity along x
    np.testing.assert_allclose(seen[:, -3:], [[0.6, 0.8, 1.0], [0.6, 0.8, 1.0], [0.8, -0.6, 1.0]], atol=1e-9)
    at_the_goal = body_view(observation, np.ones((3, 2)), np.ones((3, 2)))
    np.testing.assert_array_equal(at_the_goal[:, -3:], 0.0)


def test_placed_body_view_shows_where_the_body_is_as_well() -> None:
    observation, achieved, goal = (rows(20, dim, dim).astype(np.float64) for dim in (27, 2, 2))
    upright = np.tile([np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)], (20, 1))  # facing along y
    observation[:, 1:5] = upright
    seen = placed_body_view(observation, achieved, goal)
    assert seen.shape == (20, 33)
    np.testing.assert_array_equal(seen[:, :29], body_view(observation, achieved, goal))
    np.testing.assert_allclose(seen[:, 29:31] / seen[0, 29] * achieved[0, 0], achieved)
    np.testing.assert_allclose(seen[:, 31:], [[0.0, 1.0]] * 20, atol=1e-9)


@pytest.mark.parametrize(("observation_dim", "goal_dim"), [(10, 2), (12, 2), (27, 3)])
def test_body_view_refuses_what_is_no_such_body(observation_dim: int, goal_dim: int) -> None:
    with pytest.raises(ValueError, match="The body views are for free bodies"):
        body_view(rows(2, observation_dim, 0), rows(2, goal_dim, 1), rows(2, goal_dim, 2))


@pytest.mark.parametrize("name", ["relative", "egocentric"])
@pytest.mark.parametrize("unit", [0.05, 4.0])
def test_scaled_view_measures_goal_space_in_units(name: str, unit: float) -> None:
    rest, achieved, goal = rows(6, 3, 0), rows(6, 2, 1), rows(6, 2, 2)
    observation = np.concatenate([achieved, rest], axis=1)
    seen = ScaledView(VIEWS[name], Ball(unit))(observation, achieved, goal)
    assert seen.dtype == np.float32
    assert seen.flags.c_contiguous
    np.testing.assert_allclose(seen[:, -2:], (goal - achieved) / unit, rtol=1e-4, atol=1e-5)
    if name == "relative":
        np.testing.assert_allclose(seen[:, 5:7], achieved / unit, rtol=1e-5)
        np.testing.assert_array_equal(seen[:, :5], observation)  # what is not goal space keeps its units


@pytest.mark.parametrize("view", [relative_view, egocentric_view, lambda o, a, g: np.concatenate([o, o, g], axis=1)])
def test_scaled_view_knows_its_length(view: View) -> None:
    scaled = ScaledView(view, Ball(0.5))
    assert scaled.dim(6, 2) == scaled(rows(3, 6, 0), rows(3, 2, 1), rows(3, 2, 2)).shape[1]


def test_scaled_view_is_float32_whatever_comes_in() -> None:
    seen = ScaledView(relative_view, Ball(2.0))(rows(2, 4, 0).astype(np.float64), np.ones((2, 2)), np.zeros((2, 2)))
    assert seen.dtype == np.float32
    np.testing.assert_allclose(seen[:, -2:], -0.5)
