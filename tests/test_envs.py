import copy
import itertools
import math
import pickle
import subprocess
import sys
import tempfile
import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from stable_baselines3.common.env_checker import check_env

import sb3_skillgraph.envs as envs
from sb3_skillgraph.envs.task import decode_rng, encode_rng

TOY, POINT, ANT = "SkillGraph/ToyMaze-v0", "SkillGraph/PointMazeMedium-v0", "SkillGraph/AntUMaze-v0"
IDS = [
    TOY,
    "SkillGraph/PointMazeUMaze-v0",
    POINT,
    "SkillGraph/PointMazeHard-v0",
    "SkillGraph/PointMaze-v0",
    ANT,
    "SkillGraph/AntReacher-v0",
    "SkillGraph/AntMedium-v0",
    "SkillGraph/AntLarge-v0",
    "SkillGraph/AntMaze-v0",
]
CAR = "car"  # the point maze with the paper's robot
BODIES = [TOY, POINT, CAR, ANT]
# A non-square maze with a dead end, an "r" that is not the first free cell, and two rooms that touch at a corner only.
ODD_MAZE: envs.MazeMap = [
    [1, 1, 1, 1, 1, 1, 1],
    [1, 0, 0, "r", 1, 0, 1],
    [1, 0, 1, 0, 1, 0, 1],
    [1, 0, 1, "g", 0, "c", 1],
    [1, 1, 1, 1, 1, 1, 1],
]
MAZES = {
    "u": envs.U_MAZE,
    "medium": envs.MEDIUM_MAZE,
    "large": envs.LARGE_MAZE,
    "open": envs.OPEN_AREA,
    "odd": ODD_MAZE,
}


GEOMETRIES = {name: envs.MazeGeometry(maze_map) for name, maze_map in MAZES.items()}


def make(env_id: str, **kwargs: Any) -> gym.Env:
    if env_id == CAR:
        return gym.make(POINT, robot="car", **kwargs)
    if env_id.endswith(("PointMaze-v0", "AntMaze-v0")):
        kwargs.setdefault("maze_map", ODD_MAZE)
    return gym.make(env_id, **kwargs)


def far_pair(env: gym.Env) -> tuple[np.ndarray, np.ndarray]:
    cells = env.unwrapped.geometry.free_cells
    return tuple(env.unwrapped.geometry.cell_to_xy(*cell) for cell in (cells[0], cells[-1]))


def assert_same(a: Any, b: Any) -> None:
    assert type(a) is type(b)
    if isinstance(a, dict):
        assert a.keys() == b.keys()
        for key in a:
            assert_same(a[key], b[key])
    elif isinstance(a, tuple | list):
        for x, y in zip(a, b, strict=True):
            assert_same(x, y)
    else:
        np.testing.assert_array_equal(a, b, strict=isinstance(a, np.ndarray))


# --- geometry


@pytest.mark.parametrize("name", ["U_MAZE", "MEDIUM_MAZE", "LARGE_MAZE"])
def test_maps_are_those_of_gymnasium_robotics(name):
    from gymnasium_robotics.envs.maze import maps

    assert getattr(envs, name) == getattr(maps, name)


def test_cells_lie_where_gymnasium_robotics_puts_them():
    env = make("SkillGraph/PointMaze-v0").unwrapped
    for cell in env.geometry.free_cells:
        np.testing.assert_array_equal(env.geometry.cell_to_xy(*cell), env.maze.cell_rowcol_to_xy(np.array(cell)))


def test_walls_of_the_geometry_are_those_of_the_model():
    env = make(ANT).unwrapped
    names = [env.model.geom(i).name for i in range(env.model.ngeom)]
    blocks = [env.model.geom(name) for name in names if name.startswith("block")]
    from_model = {(*(block.pos[:2] - block.size[:2]), *(2 * block.size[:2])) for block in blocks}
    assert from_model == set(env.geometry.walls())


def test_start_cell_is_the_r_cell_else_the_first_free_cell():
    assert envs.MazeGeometry(ODD_MAZE).start_cell == (1, 3)
    assert envs.MazeGeometry(envs.U_MAZE).start_cell == (1, 1)


def test_free_area_of_the_reacher_is_ten_metres_to_each_side_of_the_start():
    geometry = make("SkillGraph/AntReacher-v0").unwrapped.geometry
    np.testing.assert_array_equal(geometry.cell_to_xy(*geometry.start_cell), [0, 0])
    assert geometry.is_free([[9.99, 9.99], [-9.99, -9.99], [9.99, -9.99], [0, 9.99]]).all()
    assert not geometry.is_free([[10.0, 0], [-10.0, 0], [0, 10.0], [0, -10.0], [13, 0], [99, 0], [np.nan, 0]]).any()


def test_discs_in_free_space():
    geometry = envs.MazeGeometry(envs.U_MAZE)  # a wall covers x <= 0.5, -0.5 <= y <= 0.5
    assert geometry.is_free([[-1, 1], [-1, 0], [-1, 0.51], [-1, 0.5]]).tolist() == [True, False, True, False]
    assert geometry.is_free([[-1, 0.59], [-1, 0.61], [0.571, 0.571]], 0.1).tolist() == [False, True, True]
    assert geometry.is_free([[0.57, 0.57]], 0.1).tolist() == [False]  # the distance to the corner is 0.099
    assert geometry.is_free([[-1, 0.61]], 0.9).tolist() == [False]  # wider than a cell


@pytest.mark.parametrize(
    ("maze_map", "message"),
    [
        ([], "rectangle"),
        ([[]], "rectangle"),
        ([[1, 1, 1], [1, 0, 1], [1, 1]], "rectangle"),
        ([[1, 1, 1], [1, 2, 1], [1, 1, 1]], "each entry"),
        ([[1, 1, 1], [1, 0, 0], [1, 1, 1]], "closed"),
        ([[1, 1, 1], [1, 1, 1], [1, 1, 1]], "free cell"),
    ],
)
def test_unusable_maps_are_refused(maze_map, message):
    with pytest.raises(ValueError, match=message):
        envs.MazeGeometry(maze_map)


def test_unusable_numbers_are_refused():
    with pytest.raises(ValueError, match="cell_size"):
        envs.MazeGeometry(envs.U_MAZE, 0.0)
    geometry = envs.MazeGeometry(envs.U_MAZE)
    with pytest.raises(ValueError, match="no free area"):
        geometry.sample_free(np.random.default_rng(0), 0.6)
    with pytest.raises(ValueError, match="margin"):
        geometry.shortest_path_length([-1, 1], [-1, -1], 0.5)


def test_known_shortest_paths():
    u = envs.MazeGeometry(envs.U_MAZE, 2.0)
    assert u.shortest_path_length([-2, 2], [2, 2]) == pytest.approx(4)
    assert u.shortest_path_length([-2, 2], [-2, -2]) == pytest.approx(2 * math.hypot(3, 1) + 2, abs=1e-4)
    # Round the end of the wall at distance 0.2: to the circle around a corner, along it, straight, and so on.
    radius, reach = 0.2, math.hypot(3, 1)
    turning = math.pi - 2 * (math.atan2(1, 3) - math.asin(radius / reach))
    by_hand = 2 * math.sqrt(reach**2 - radius**2) + radius * turning + 2
    assert u.shortest_path_length([-2, 2], [-2, -2], radius) == pytest.approx(by_hand, rel=0.03)
    large = envs.MazeGeometry(envs.LARGE_MAZE)
    bends = [[-4.5, 3], [-0.5, 1.5], [-0.5, 1.0], [0.5, -1.0], [0.5, -1.5]]
    length = sum(math.dist(p, q) for p, q in itertools.pairwise(bends))
    assert large.shortest_path_length(bends[0], bends[-1]) <= length * 1.06


def test_no_way_through_walls_or_where_two_walls_touch():
    rooms = [[1, 1, 1, 1, 1, 1], [1, 0, 1, 1, 0, 1], [1, 1, 0, 1, 0, 1], [1, 1, 1, 1, 1, 1]]
    geometry = envs.MazeGeometry(rooms)
    first, touching, other, below = (geometry.cell_to_xy(*cell) for cell in [(1, 1), (2, 2), (1, 4), (2, 4)])
    for margin in (0.0, 1e-7, 0.1, 0.4):
        assert geometry.shortest_path_length(first, touching, margin) == math.inf
        assert geometry.shortest_path_length(first, other, margin) == math.inf
        assert geometry.shortest_path_length(other, below, margin) == pytest.approx(1)
    assert geometry.shortest_path_length(first, [0, 0.5]) == math.inf  # an end in a wall


def test_no_way_between_the_cells_of_a_thick_wall():
    # The ends of the long wall are on one line with the seam between it and the wall below it.
    maze_map = [[1] * 10, [1] + [0] * 8 + [1], [1, 0, 1, 1, 1, 1, 1, 1, 0, 1], [1, 0, 0, 0, 1, 1, 0, 0, 0, 1], [1] * 10]
    for turned in (maze_map, [list(row) for row in zip(*maze_map, strict=True)]):
        geometry = envs.MazeGeometry(turned)
        cells = [(3, 2), (3, 7)] if turned is maze_map else [(2, 3), (7, 3)]
        ends = [geometry.cell_to_xy(*cell) for cell in cells]
        assert geometry.shortest_path_length(*ends) == pytest.approx(8 + math.sqrt(2))


def grid_path_length(geometry: envs.MazeGeometry, a: np.ndarray, b: np.ndarray, n: int = 8) -> float:
    """Reference: shortest way on a fine grid, at most 8.3 % too long plus the steps to the grid."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import dijkstra

    x_min, x_max, y_min, y_max = geometry.extent
    step = geometry.cell_size / n
    xs, ys = (np.arange(low + step / 2, high, step) for low, high in ((x_min, x_max), (y_min, y_max)))
    points = np.stack(np.meshgrid(xs, ys), -1).reshape(-1, 2)
    points = points[geometry.is_free(points)]
    gaps = np.linalg.norm(points[:, None] - points[None], axis=-1)
    i, j = np.nonzero((gaps > 0) & (gaps < 1.5 * step))
    graph = coo_array((gaps[i, j], (i, j)), shape=gaps.shape).tocsr()
    ends = [np.linalg.norm(points - end, axis=1) for end in (a, b)]
    between = dijkstra(graph, indices=ends[0].argmin())[ends[1].argmin()]
    return float(ends[0].min() + between + ends[1].min())


@pytest.mark.parametrize("name", ["u", "odd", "medium"])
def test_shortest_paths_agree_with_a_fine_grid(name):
    geometry, rng = envs.MazeGeometry(MAZES[name]), np.random.default_rng(0)
    for _ in range(5):
        a, b = geometry.sample_free(rng), geometry.sample_free(rng)
        length, on_grid = geometry.shortest_path_length(a, b), grid_path_length(geometry, a, b)
        assert length <= on_grid * 1.0001
        assert length >= on_grid / 1.083 - 0.5


@settings(max_examples=60, deadline=None)
@given(name=st.sampled_from(sorted(MAZES)), margin=st.sampled_from([0.0, 0.1, 0.225]), seed=st.integers(0, 2**32 - 1))
def test_samples_and_paths(name, margin, seed):
    geometry, rng = GEOMETRIES[name], np.random.default_rng(seed)
    a, b, c = (geometry.sample_free(rng, margin) for _ in range(3))
    assert geometry.is_free([a, b, c], margin).all()
    x, y, w, h = np.array(geometry.walls()).T
    gap_x, gap_y = np.maximum(np.maximum(x - a[0], a[0] - x - w), 0), np.maximum(np.maximum(y - a[1], a[1] - y - h), 0)
    assert np.hypot(gap_x, gap_y).min() > margin * (1 - 1e-9)
    there = geometry.shortest_path_length(a, b, margin)
    assert np.isfinite(there)
    assert there >= np.linalg.norm(a - b) * (1 - 1e-12)
    assert there == pytest.approx(geometry.shortest_path_length(b, a, margin), rel=1e-12)
    through = geometry.shortest_path_length(a, c, margin) + geometry.shortest_path_length(c, b, margin)
    assert there <= through * (1 + 1e-5)
    assert there >= geometry.shortest_path_length(a, b, 0.0) * (1 - 1e-5)


def test_samples_are_uniform_over_the_free_area():
    geometry, rng = envs.MazeGeometry(ODD_MAZE, 2.0), np.random.default_rng(1)
    points = np.array([geometry.sample_free(rng, 0.3) for _ in range(4000)])
    # Share of the points in boxes, against their area within the margin on a fine lattice.
    xs, ys = (np.arange(low, high, 0.05) + 0.025 for low, high in (geometry.extent[:2], geometry.extent[2:]))
    lattice = np.stack(np.meshgrid(xs, ys), -1).reshape(-1, 2)
    lattice = lattice[geometry.is_free(lattice, 0.3)]
    bins = [np.linspace(*geometry.extent[:2], 15), np.linspace(*geometry.extent[2:], 11)]
    expected = np.histogram2d(*lattice.T, bins=bins)[0] / len(lattice) * len(points)
    counted = np.histogram2d(*points.T, bins=bins)[0]
    filled = expected > 0
    assert counted[~filled].sum() == 0
    chi2 = ((counted - expected)[filled] ** 2 / expected[filled]).sum()
    assert chi2 < filled.sum() + 5 * math.sqrt(2 * filled.sum())


# --- all environments


@pytest.mark.parametrize("env_id", [*IDS, CAR])
def test_makes_resets_steps_and_passes_the_check(env_id):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = make(env_id)
        assert env.spec.max_episode_steps is None
        observation, info = env.reset(seed=0)
        assert info.keys() == {"success", "is_success"}
        start = env.unwrapped.geometry.cell_to_xy(*env.unwrapped.geometry.start_cell)
        assert np.abs(observation["achieved_goal"] - start).max() <= 0.1
        for _ in range(5):
            observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
            reached = env.unwrapped.compute_reward(observation["achieved_goal"], observation["desired_goal"], info)
            assert reward == reached == float(info["success"])
            assert not terminated
            assert not truncated
        check_env(env.unwrapped)
    env.close()


def test_importing_and_making_the_toy_does_not_load_mujoco():
    code = (
        "import sys, gymnasium as gym, sb3_skillgraph.envs; gym.make('SkillGraph/ToyMaze-v0').reset(); "
        "assert 'mujoco' not in sys.modules and 'gymnasium_robotics' not in sys.modules; "
        "gym.make('SkillGraph/PointMazeUMaze-v0').reset()"
    )
    root = Path(envs.__file__).parents[2]
    done = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=True)
    assert done.stdout == done.stderr == ""


@pytest.mark.parametrize("env_id", BODIES)
def test_start_and_goal_options(env_id):
    env = make(env_id)
    start, goal = far_pair(env)
    observation, _ = env.reset(seed=0, options={"start": start, "goal": tuple(goal)})
    np.testing.assert_array_equal(observation["achieved_goal"], start)
    np.testing.assert_array_equal(observation["desired_goal"], goal)
    observation = env.step(np.zeros(env.action_space.shape, dtype=np.float32))[0]
    np.testing.assert_array_equal(observation["desired_goal"], goal)
    assert np.linalg.norm(observation["achieved_goal"] - start) < 0.1

    plain, _ = env.reset(seed=3)
    only_goal, _ = env.reset(seed=3, options={"goal": goal, "start": None})
    np.testing.assert_array_equal(only_goal["achieved_goal"], plain["achieved_goal"])
    np.testing.assert_array_equal(only_goal["desired_goal"], goal)
    only_start, _ = env.reset(seed=3, options={"start": goal})
    np.testing.assert_array_equal(only_start["achieved_goal"], goal)
    np.testing.assert_array_equal(only_start["desired_goal"], plain["desired_goal"])
    again, _ = env.reset(seed=3)
    assert_same(again, plain)


def test_the_goal_is_copied_from_the_options_and_into_the_observation():
    env = make(TOY)
    goal = np.array([1.0, 1.0])
    observation, _ = env.reset(options={"goal": goal})
    goal += 5
    observation["desired_goal"] += 5
    observation = env.step(env.action_space.sample())[0]
    np.testing.assert_array_equal(observation["desired_goal"], [1.0, 1.0])


@pytest.mark.parametrize("env_id", [POINT, CAR, ANT])
def test_the_goal_mark_moves_in_the_model(env_id):
    env = make(env_id)
    task = env.unwrapped
    for _ in range(2):
        observation, _ = env.reset()
        np.testing.assert_array_equal(task.model.site("target").pos[:2], observation["desired_goal"])
    state = task.get_state()
    env.reset()
    task.set_state(state)
    np.testing.assert_array_equal(task.model.site("target").pos[:2], observation["desired_goal"])


@pytest.mark.parametrize("name", ["start", "goal"])
@pytest.mark.parametrize(
    "value", [(-1.0, 0.0), (99.0, 0.0), (np.nan, 1.0), (1.0, np.inf), (1.0, 1.0, 1.0), [[1.0, 1.0]], 1.0, "north"]
)
def test_unusable_positions_are_refused(name, value):
    env = make("SkillGraph/PointMazeUMaze-v0")
    env.reset(seed=0)
    before = env.unwrapped.get_state()
    with pytest.raises(ValueError, match=f"'{name}' is .*free space"):
        env.reset(options={name: value})
    assert_same(env.unwrapped.get_state(), before)


def test_a_start_leaves_room_for_the_body_and_a_goal_need_not():
    env = make(ANT)
    near_wall = env.unwrapped.geometry.cell_to_xy(1, 1) + np.array([0, 1.5])
    env.reset(options={"goal": near_wall})
    with pytest.raises(ValueError, match=r"0\.9 away"):
        env.reset(options={"start": near_wall})


def test_unknown_options_are_refused():
    with pytest.raises(ValueError, match=r"goal_cell.*'start' and 'goal'"):
        make(TOY).reset(options={"goal_cell": [1, 1]})


def test_unusable_arguments_are_refused():
    with pytest.raises(ValueError, match="maze_map is required"):
        gym.make("SkillGraph/PointMaze-v0")
    for kwargs in ({"success_radius": 0.0}, {"success_radius": np.nan}, {"max_steps": 0}, {"step_size": 2.0}):
        with pytest.raises(ValueError, match=next(iter(kwargs))):
            make(TOY, **kwargs)


@pytest.mark.parametrize("env_id", BODIES)
def test_goals_and_samples_cover_where_the_body_fits(env_id):
    env = make(env_id)
    rng = np.random.default_rng(0)
    env.reset(seed=0)
    goals = np.array([env.reset()[0]["desired_goal"] for _ in range(100)])
    samples = np.array([env.get_wrapper_attr("sample_free")(rng) for _ in range(100)])
    task = env.unwrapped
    for points in (goals, samples):
        assert task.geometry.is_free(points, task.body_radius).all()
        assert len(np.unique(np.floor(points / task.geometry.cell_size - 0.5), axis=0)) >= 7
    env.reset(options={"start": samples[0], "goal": goals[0]})


@pytest.mark.parametrize("env_id", BODIES)
def test_same_seed_same_episode(env_id):
    env, other = make(env_id), make(env_id)
    env.reset(seed=1)
    assert_same(env.reset(seed=7), other.reset(seed=7))
    assert_same(env.reset(), other.reset())
    assert not np.array_equal(env.reset()[0]["desired_goal"], env.reset()[0]["desired_goal"])


@pytest.mark.parametrize("env_id", BODIES)
def test_truncates_at_max_steps(env_id):
    env = make(env_id, max_steps=3)
    for _ in range(2):
        env.reset(seed=0)
        ends = [env.step(env.action_space.sample())[2:4] for _ in range(3)]
        assert ends == [(False, False), (False, False), (False, True)]
        assert env.unwrapped.get_state()["elapsed_steps"] == 3


def walk_through_goal(env: gym.Env) -> list[tuple[float, bool, dict[str, Any]]]:
    """Walk a toy from (-1, 1) to (1, 1), the goal (0, 1) lying in between."""
    _, info = env.reset(options={"start": (-1, 1), "goal": (0, 1)})
    assert not info["is_success"]
    return [(step[1], step[2], step[4]) for step in (env.step(np.array([1, 0], dtype=np.float32)) for _ in range(8))]


def test_success_is_latched_within_the_episode():
    env = make(TOY)
    for _ in range(2):
        steps = walk_through_goal(env)
        now = [info["success"] for _, _, info in steps]
        assert now == [False, False, True, True, True, False, False, False]
        assert [reward for reward, _, _ in steps] == [float(success) for success in now]
        assert [info["is_success"] for _, _, info in steps] == [False, False] + 6 * [True]
        assert not any(terminated for _, terminated, _ in steps)


@pytest.mark.parametrize("env_id", BODIES)
def test_starting_at_the_goal_is_success_at_reset(env_id):
    env = make(env_id)
    start, _ = far_pair(env)
    _, info = env.reset(options={"start": start, "goal": start})
    assert info == {"success": True, "is_success": True}
    assert env.step(env.action_space.sample())[4]["is_success"] is True


@pytest.mark.parametrize("env_id", BODIES)
def test_terminate_on_success(env_id):
    env = make(env_id, terminate_on_success=True)
    start, goal = far_pair(env)
    env.reset(options={"start": start, "goal": goal})
    assert env.step(env.action_space.sample())[2] is False
    env.reset(options={"start": goal, "goal": goal})
    _, reward, terminated, _, info = env.step(np.zeros(env.action_space.shape, dtype=np.float32))
    assert reward == 1.0
    assert terminated is True
    assert info["is_success"]
    assert env.unwrapped.compute_terminated(goal, goal, {})
    assert not env.unwrapped.compute_terminated(start, goal, {})


def test_success_radius_is_used_everywhere():
    env = make(TOY, success_radius=0.2, terminate_on_success=True)
    assert [info["success"] for _, _, info in walk_through_goal(env)][:5] == [False, False, False, True, False]
    task = env.unwrapped
    goals = np.array([[0.0, 0.19], [0.0, 0.21]])
    rewards = task.compute_reward(np.zeros((2, 2)), goals, [{}, {}])
    assert rewards.tolist() == [1.0, 0.0]
    assert rewards.dtype == np.float64
    assert task.compute_reward(np.zeros(2), goals[0], {}) == 1.0
    assert [task.compute_terminated(np.zeros(2), goal, {}) for goal in goals] == [True, False]


# --- state


def play(env: gym.Env, actions: list[np.ndarray]) -> list[Any]:
    """Two episodes: the rest of the present one, then one with what the next reset draws."""
    half = len(actions) // 2
    first = [env.step(action) for action in actions[:half]]
    return [*first, env.reset(), *(env.step(action) for action in actions[half:])]


@pytest.mark.parametrize("env_id", BODIES)
def test_continuation_from_a_state_is_exact(env_id):
    env = make(env_id, max_steps=90)
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(100)]
    env.reset(seed=0)
    start = env.unwrapped.geometry.cell_to_xy(*env.unwrapped.geometry.start_cell)
    env.reset(options={"goal": start})
    for _ in range(40):
        env.step(env.action_space.sample())
    state = env.unwrapped.get_state()
    assert all(isinstance(array, np.ndarray) for array in state.values())
    assert state["elapsed_steps"] == 40
    assert state["has_succeeded"]
    kept = copy.deepcopy(state)
    expected = play(env, actions)
    assert expected[49][3]  # the time limit went on from step 40
    assert_same(state, kept)

    env.unwrapped.set_state(state)
    assert_same(play(env, actions), expected)
    fresh = make(env_id, max_steps=90)
    fresh.reset()
    fresh.unwrapped.set_state(state)
    assert_same(fresh.unwrapped.get_state(), state)
    assert_same(play(fresh, actions), expected)


@pytest.mark.parametrize("env_id", BODIES)
def test_copies_go_on_alike(env_id):
    env = make(env_id)
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(20)]
    env.reset(seed=0)
    env.step(actions[0])
    copies = [copy.deepcopy(env), pickle.loads(pickle.dumps(env))]
    expected = play(env, actions)
    for other in copies:
        assert_same(play(other, actions), expected)


def test_a_state_of_another_kind_is_refused():
    toy, point = make(TOY).unwrapped, make(POINT).unwrapped
    with pytest.raises(ValueError, match="shapes"):
        toy.set_state(point.get_state())
    state = toy.get_state()
    del state["rng"]
    with pytest.raises(ValueError, match="shapes"):
        toy.set_state(state)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**64), n_32_bit=st.integers(0, 3), n_doubles=st.integers(0, 3))
def test_generator_states_survive_as_arrays(seed, n_32_bit, n_doubles):
    rng, other = np.random.default_rng(seed), np.random.default_rng(0)
    rng.integers(10, size=n_32_bit, dtype=np.uint32)  # an odd number leaves half a word in store
    rng.random(n_doubles)
    decode_rng(other, encode_rng(rng))
    assert other.bit_generator.state == rng.bit_generator.state


# --- bodies


@pytest.mark.parametrize("env_id", [POINT, ANT])
def test_no_temporary_files_stay_behind(env_id, tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    env = make(env_id)
    env.reset(seed=0)
    copy.deepcopy(env)
    assert tempfile.gettempdir() == str(tmp_path)
    assert list(tmp_path.iterdir()) == []
    env.close()


def test_the_ball_may_start_where_it_has_been():
    env = make(POINT)
    rng = np.random.default_rng(0)
    env.reset(seed=0)
    visited = []
    for step in range(900):
        if step % 30 == 0:
            action = rng.choice([-1.0, 1.0], size=2).astype(np.float32)
        visited.append(env.step(action)[0]["achieved_goal"])
    task = env.unwrapped
    touching = [xy for xy in visited if not task.geometry.is_free(xy, task.body_radius).all()]
    assert touching
    for xy in touching:
        env.reset(options={"start": xy})


def test_the_ant_has_the_torque_and_period_of_d4rl():
    env = make(ANT).unwrapped
    assert env.ant_env.dt == pytest.approx(0.1)
    assert env.action_space == gym.spaces.Box(-1, 1, (8,), np.float32)
    env.reset(seed=0)
    env.step(np.ones(8, dtype=np.float32))
    np.testing.assert_allclose(env.data.qfrc_actuator[6:], 30.0)
    assert env.observation_space["observation"].shape == (27,)


def test_an_ant_on_its_back_is_stuck_until_the_reset():
    env = make(ANT)
    still = np.zeros(8, dtype=np.float32)
    assert "stuck" not in env.reset(seed=0)[1]
    assert "stuck" not in env.step(still)[4]
    env.unwrapped.data.qpos[2:7] = [1.0, 0.0, 1.0, 0.0, 0.0]
    for _ in range(30):
        *_, terminated, truncated, info = env.step(still)
        assert info["stuck"]
        assert not (terminated or truncated)  # it is the agent that gives up
    assert "stuck" not in env.reset()[1]


def test_an_ant_need_not_be_that_of_d4rl():
    env = make(ANT, torque=150, frame_skip=5, tell_stuck=False)
    assert (env.unwrapped.model.actuator_gear[:, 0] == 150).all()
    assert env.metadata["render_fps"] == 20
    env.reset(seed=0)
    before = env.unwrapped.data.time
    env.unwrapped.data.qpos[2:7] = [1.0, 0.0, 1.0, 0.0, 0.0]
    assert "stuck" not in env.step(np.zeros(8, dtype=np.float32))[4]
    assert env.unwrapped.data.time - before == pytest.approx(0.05)
    assert pickle.loads(pickle.dumps(env)).unwrapped.tell_stuck is False


@pytest.mark.parametrize("kwargs", [{"torque": 0}, {"torque": np.nan}, {"frame_skip": 0}, {"frame_skip": 5.5}], ids=str)
def test_an_ant_that_cannot_be(kwargs):
    with pytest.raises(ValueError, match=rf"{next(iter(kwargs))} must be a .*, not"):
        make(ANT, **kwargs)


def test_random_actions_rarely_flip_the_ant():
    env = make("SkillGraph/AntReacher-v0")
    env.action_space.seed(0)
    upright = []
    for seed in range(5):
        env.reset(seed=seed)
        for _ in range(200):
            observation = env.step(env.action_space.sample())[0]
        _, x, y, _ = observation["observation"][1:5]
        upright.append(1 - 2 * (x**2 + y**2) > 0)
    assert np.mean(upright) >= 0.8


@settings(max_examples=40, deadline=None)
@given(data=st.data(), seed=st.integers(0, 2**32 - 1))
def test_the_toy_slides_along_walls_and_never_enters_them(data, seed):
    size = data.draw(st.floats(0.05, 1.0))
    env = envs.ToyMazeEnv(maze_map=ODD_MAZE, step_size=size)
    observation, _ = env.reset(seed=seed)
    for _ in range(40):
        action = np.array(data.draw(st.tuples(st.floats(-2, 2), st.floats(-2, 2))), dtype=np.float32)
        before = observation["achieved_goal"]
        observation = env.step(action)[0]
        moved = observation["achieved_goal"] - before
        assert env.geometry.is_free(observation["achieved_goal"]).all()
        wanted = size * np.clip(action.astype(np.float64), -1, 1)
        assert all(m == pytest.approx(w, abs=1e-12) or m == 0 for m, w in zip(moved, wanted, strict=True))
        if env.geometry.is_free(before + wanted * [1, 0])[0]:
            assert moved[0] == pytest.approx(wanted[0], abs=1e-12)


@settings(max_examples=40, deadline=None)
@given(rows=st.integers(1, 4), columns=st.integers(1, 4), seed=st.integers(0, 2**32 - 1))
def test_geometry_of_any_closed_map(rows, columns, seed):
    rng = np.random.default_rng(seed)
    inner = (rng.random((rows, columns)) < 0.4).astype(int)
    assume((inner == 0).any())
    geometry = envs.MazeGeometry(np.pad(inner, 1, constant_values=1).tolist(), 0.7)
    a, b = geometry.sample_free(rng, 0.1), geometry.sample_free(rng, 0.1)
    finite = [math.isfinite(geometry.shortest_path_length(a, b, margin)) for margin in (0.0, 0.1)]
    # Reachable just when a chain of cells with common sides connects the two.
    cells = {(int((0.35 * (rows + 2) - y) // 0.7), int((x + 0.35 * (columns + 2)) // 0.7)) for x, y in (a, b)}
    reached = {next(iter(cells))}
    for _ in range(rows * columns):
        reached |= {(i, j) for i, j in geometry.free_cells if any(abs(i - k) + abs(j - m) == 1 for k, m in reached)}
    assert finite == [cells <= reached] * 2


def test_the_toy_draws_itself():
    env = make(TOY, render_mode="rgb_array")
    env.reset(options={"start": (-1, 1), "goal": (1, -1)})
    image = env.render()
    assert image.shape == (160, 160, 3)
    assert image.dtype == np.uint8
    drawn = {"body": (-1, 1), "goal": (1, -1), "wall": (-1, 0), "free": (0, 1)}
    at = {name: tuple(image[int((2.5 - y) * 32), int((x + 2.5) * 32)]) for name, (x, y) in drawn.items()}
    assert len(set(at.values())) == 4
    assert make(TOY).unwrapped.render() is None


# --- the car


def test_the_car_turns_then_drives_along_its_heading():
    env = make(CAR)
    task = env.unwrapped
    assert (task.geometry.cell_size, task.success_radius) == (3.0, 0.6)
    assert env.observation_space["observation"].shape == (6,)
    start = task.geometry.cell_to_xy(3, 3)
    env.reset(options={"start": start})
    observation = env.step(np.array([0.5, 1.0], dtype=np.float32))[0]["observation"]
    np.testing.assert_allclose(observation[:3], [*(start + 0.5 * np.array([np.cos(0.25), np.sin(0.25)])), 0.25])
    np.testing.assert_allclose(observation[3:] * 0.05, observation[:3] - [*start, 0.0])
    for _ in range(20):
        heading = env.step(np.array([0.0, 1.0], dtype=np.float32))[0]["observation"][2]
    assert heading == pytest.approx(21 * 0.25 - 2 * np.pi)


@pytest.mark.parametrize("seed", [0, 1])
def test_the_car_stays_out_of_the_walls_but_turns_beside_them(seed):
    env, rng = make(CAR), np.random.default_rng(seed)
    env.reset(seed=seed)
    points = []
    for _ in range(600):
        observation = env.step(np.array([rng.uniform(-1, 1), rng.uniform(-1, 1)], dtype=np.float32))[0]["observation"]
        points.append(observation[:2])
    assert env.unwrapped.geometry.is_free(np.array(points), 0.39).all()
    stuck = np.flatnonzero((np.diff(points, axis=0) == 0).all(axis=1))
    assert len(stuck) > 5
    assert len(np.unique(np.round(points, 1), axis=0)) > 50


def test_an_unknown_robot():
    with pytest.raises(ValueError, match="unknown robot 'truck': use 'ball' or 'car'"):
        gym.make(POINT, robot="truck")
