"""The mazes of OGBench as goal environments."""

import copy
import tempfile
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from conftest import differences, new_agent
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import SubprocVecEnv

from sb3_skillgraph.envs import find
from sb3_skillgraph.envs.ogbench_mazes import OGBenchMazeEnv
from sb3_skillgraph.hyperparams import load_hyperparams, make_recommended

pytest.importorskip("ogbench")
pytestmark = pytest.mark.mujoco

POINT, GIANT, TELEPORT = (f"SkillGraph/OGBenchPoint{maze}-v0" for maze in ("Medium", "Giant", "Teleport"))
ANT = "SkillGraph/OGBenchAntMedium-v0"
#: Below one of the teleporters, which takes whoever comes within 1.5 of it, and the step that leads up to it.
TELEPORTER, BELOW, UP = np.array([20.0, 12.0]), np.array([20.0, 10.2]), np.array([0.0, 1.0], dtype=np.float32)


def make(env_id: str = POINT, **kwargs: Any) -> Any:
    return gym.make(env_id, **kwargs).unwrapped


def same(a: Any, b: Any) -> bool:
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    if isinstance(a, list | tuple):
        return len(a) == len(b) and all(map(same, a, b))
    return bool(np.array_equal(a, b))


def go_up(env: Any) -> list[np.ndarray]:
    """Go up into the teleporter; where the body was, up to the step on which it was taken elsewhere."""
    points = [env.reset(options={"start": BELOW})[0]["achieved_goal"]]
    while np.linalg.norm(points[-1] - BELOW) < 2.0:
        assert len(points) < 20
        points.append(env.step(UP)[0]["achieved_goal"])
    return points


def exits(env: Any, seed: int, n: int) -> list[int]:
    """Which of its exits the teleporter chooses."""
    env.reset(seed=seed)
    ways_out = np.array(env.maze._teleport_info["teleport_out_xys"])
    ends = np.array([go_up(env)[-1] for _ in range(n)])
    distances = np.linalg.norm(ends[:, None] - ways_out, axis=2)
    assert distances.min(axis=1).max() < 1e-9
    return distances.argmin(axis=1).tolist()


# -- what it looks like -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("env_id", "n_body", "n_actions", "radius", "view"), [(POINT, 2, 2, 1.0, "relative"), (ANT, 27, 8, 0.5, "placed_body")]
)
def test_spaces(env_id: str, n_body: int, n_actions: int, radius: float, view: str) -> None:
    env = make(env_id)
    shapes = {key: space.shape for key, space in env.observation_space.spaces.items()}
    assert shapes == {"observation": (n_body,), "achieved_goal": (2,), "desired_goal": (2,)}
    assert env.action_space.shape == (n_actions,)
    assert (env.success_radius, env.option_view, env.max_steps) == (radius, view, 1000)
    check_env(env)
    observation, info = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    assert info == {"success": False, "is_success": False}


def test_all_mazes_are_registered() -> None:
    mazes = {
        f"SkillGraph/OGBench{body}{maze}-v0" for body in ("Point", "Ant") for maze in ("Medium", "Large", "Giant", "Teleport")
    }
    assert mazes == {env_id for env_id in gym.registry if "OGBench" in env_id}


@pytest.mark.parametrize("env_id", [POINT, GIANT, TELEPORT])
def test_walls_and_tasks_are_those_of_ogbench(env_id: str) -> None:
    env = make(env_id)
    model, geometry = env.maze.model, env.geometry
    blocks = [model.geom(i) for i in range(model.ngeom) if model.geom(i).name.startswith("block")]
    theirs = {(*(block.pos[:2] - block.size[:2]).tolist(), *(2.0 * block.size[:2]).tolist()) for block in blocks}
    assert {tuple(map(float, wall)) for wall in geometry.walls()} == theirs
    n_rows = len(geometry.maze_map)
    for row, column in geometry.free_cells:
        np.testing.assert_allclose(geometry.cell_to_xy(row, column), env.maze.ij_to_xy((n_rows - 1 - row, column)))
    assert len(env.tasks) == 5
    for ends, task in zip(env.tasks, env.maze.task_infos, strict=True):
        np.testing.assert_array_equal(ends, [task["init_xy"], task["goal_xy"]])
        assert geometry.is_free(ends, env.body_radius).all()
        assert np.isfinite(geometry.shortest_path_length(*ends)) or env_id == TELEPORT


@pytest.mark.parametrize(
    ("env_id", "ours"), [("pointmaze-teleport-v0", TELEPORT), ("ogbench:antmaze-medium-v0", ANT)], ids=["name", "package"]
)
def test_ogbenchs_own_names_stand_for_the_adapter(env_id: str, ours: str) -> None:
    find(env_id)
    env, known = make_recommended(env_id, {}), gym.make(ours)
    assert isinstance(env.unwrapped, OGBenchMazeEnv)
    settings, wanted = load_hyperparams(env_id), load_hyperparams(ours)
    assert settings == wanted
    assert same(env.reset(seed=3)[0], known.reset(seed=3)[0])
    assert same(env.step(env.action_space.high), known.step(env.action_space.high))


def test_ogbenchs_own_arguments_hold_for_the_adapter() -> None:
    find("pointmaze-medium-v0")
    env = make_recommended("pointmaze-medium-v0", dict(max_episode_steps=50, terminate_at_goal=True))
    assert (env.unwrapped.max_steps, env.unwrapped.terminate_on_success) == (50, True)  # type: ignore[attr-defined]
    env = make_recommended("pointmaze-medium-v0", {})
    assert (env.unwrapped.max_steps, env.unwrapped.terminate_on_success) == (1000, False)  # type: ignore[attr-defined]
    assert env.spec is not None
    gym.make(env.spec).close()  # as adaptation does


def test_an_agent_in_processes_of_their_own() -> None:
    env = make_vec_env("sb3_skillgraph:" + POINT, 2, vec_env_cls=SubprocVecEnv)
    try:
        assert new_agent(env).event_radius == 1.0
    finally:
        env.close()


@pytest.mark.parametrize("name", ["humanoidmaze-medium-v0", "antsoccer-arena-v0", "cube-single-v0", ""])
def test_other_environments_of_ogbench_are_refused(name: str) -> None:
    with pytest.raises(ValueError, match=f"no maze of OGBench '{name}' for a point or an ant"):
        make(POINT, name=name)


def test_a_maze_that_there_is_not() -> None:
    with pytest.raises(ValueError, match="pointmaze-huge-v0"):
        make(POINT, name="pointmaze-huge-v0")


@pytest.mark.parametrize(
    "kwargs",
    [
        {"success_radius": -1.0},
        {"success_radius": np.nan},
        {"max_steps": 0},
        {"success_radius": 0.0},
    ],
    ids=str,
)
def test_unusable_arguments_are_refused(kwargs: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(kwargs))):
        make(POINT, **kwargs)


def test_no_temporary_files_stay_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    make(POINT).reset(seed=0)
    assert list(tmp_path.iterdir()) == []


# -- episodes ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("env_id", [POINT, TELEPORT, ANT])
def test_episodes_begin_in_the_first_cell_and_goals_lie_anywhere(env_id: str) -> None:
    env = make(env_id)
    env.reset(seed=0)
    observations = [env.reset()[0] for _ in range(30)]
    starts, goals = (np.array([each[key] for each in observations]) for key in ("achieved_goal", "desired_goal"))
    assert np.abs(starts).max() <= env.start_noise
    assert len(np.unique(starts, axis=0)) == 30
    assert env.geometry.is_free(goals, env.body_radius).all()
    assert len({tuple(np.floor(goal / 4.0 + 0.5)) for goal in goals}) > 10
    again = make(env_id)
    again.reset(seed=0)
    assert same([again.reset()[0] for _ in range(30)], observations)


@pytest.mark.parametrize("env_id", [POINT, ANT])
def test_start_and_goal_options(env_id: str) -> None:
    env = make(env_id)
    start, goal = (env.geometry.cell_to_xy(*env.geometry.free_cells[i]) for i in (-1, 3))
    observation, info = env.reset(seed=0, options={"start": start, "goal": goal})
    np.testing.assert_array_equal(observation["achieved_goal"], start)
    np.testing.assert_array_equal(observation["desired_goal"], goal)
    np.testing.assert_array_equal(env.maze.model.geom("target").pos[:2], goal)  # the mark in the picture
    assert not info["is_success"]
    assert env.reset(options={"start": goal, "goal": goal})[1]["is_success"]
    for options, message in (({"start": [99.0, 0.0]}, "free space"), ({"task": 1}, "unknown reset options")):
        with pytest.raises(ValueError, match=message):
            env.reset(options=options)


def test_success_and_the_end_of_an_episode() -> None:
    right = np.array([1.0, 0.0], dtype=np.float32)
    for terminate in (False, True):
        env = make(POINT, terminate_on_success=terminate, max_steps=12)
        env.reset(seed=0, options={"start": (0.0, 0.0), "goal": (2.0, 0.0)})
        steps = [env.step(right) for _ in range(12)]
        near = [bool(np.linalg.norm(step[0]["achieved_goal"] - [2.0, 0.0]) <= 1.0) for step in steps]
        assert 0 < near.index(True) < 11
        assert [step[1] for step in steps] == [float(each) for each in near]
        assert [step[2] for step in steps] == [each and terminate for each in near]
        assert [step[3] for step in steps] == [False] * 11 + [True]


def play(env: Any, actions: np.ndarray) -> list[Any]:
    """The rest of an episode, and the beginning of the next."""
    half = len(actions) // 2
    return [*(env.step(action) for action in actions[:half]), env.reset(), *(env.step(action) for action in actions[half:])]


@pytest.mark.parametrize("env_id", [POINT, TELEPORT, ANT])
def test_continuation_from_a_state_is_exact(env_id: str) -> None:
    env = make(env_id, max_steps=40)
    actions = np.random.default_rng(0).uniform(-1, 1, (60, *env.action_space.shape)).astype(np.float32)
    env.reset(seed=0, options={"goal": (0.0, 0.0)})
    for action in actions[:25]:
        env.step(action)
    state = env.get_state()
    kept = copy.deepcopy(state)
    assert (state["elapsed_steps"], state["has_succeeded"]) == (25, True)
    expected = play(env, actions)
    assert expected[14][3]  # the time limit went on
    env.set_state(state)
    assert same(state, kept)
    assert same(play(env, actions), expected)
    fresh = make(env_id, max_steps=40)
    fresh.reset(seed=5)
    fresh.set_state(state)
    assert same(fresh.get_state(), state)
    assert same(play(fresh, actions), expected)


# -- teleporters ------------------------------------------------------------------------------------------------------


def test_an_ant_tells_when_it_is_on_its_back() -> None:
    env: Any = gym.make("SkillGraph/OGBenchAntMedium-v0")
    env.reset(seed=0)
    still = np.zeros(8, dtype=np.float32)
    assert not env.step(still)[-1].get("stuck")
    env.unwrapped.maze.data.qpos[3:7] = (0.0, 1.0, 0.0, 0.0)  # half a turn about its length
    assert env.step(still)[-1]["stuck"]
    env.close()


def test_a_teleport_is_seen_on_the_step_that_it_happens() -> None:
    env = make(TELEPORT)
    env.reset(seed=0)
    np.testing.assert_array_equal(env.maze._teleport_info["teleport_in_xys"][0], TELEPORTER)
    for _ in range(5):
        points = go_up(env)
        assert len(points) > 2
        assert min(np.linalg.norm(point - TELEPORTER) for point in points) > 1.5  # never seen where it is taken away
        np.testing.assert_array_equal(points[-1], env.maze.get_xy())
        np.testing.assert_array_equal(env._observe()["observation"], points[-1])


def test_exits_are_drawn_from_the_environments_own_generator() -> None:
    env, other = make(TELEPORT), make(TELEPORT)
    np.random.seed(7)  # noqa: NPY002 - the generator that is not to be touched
    before = np.random.get_state(legacy=False)  # noqa: NPY002
    first = exits(env, 3, 20)
    assert same(before, np.random.get_state(legacy=False))  # noqa: NPY002
    np.random.seed(8)  # noqa: NPY002
    assert exits(other, 3, 20) == first
    assert set(first) == {0, 1, 2}
    assert exits(env, 4, 20) != first


def test_an_exit_that_a_state_leads_to_stays_the_same() -> None:
    env, fresh = make(TELEPORT), make(TELEPORT)
    ends = set()
    fresh.reset(seed=1)
    for seed in range(6):
        env.reset(seed=seed, options={"start": BELOW})
        state = env.get_state()
        trajectories = []
        for each in (env, fresh):
            each.set_state(state)
            trajectories.append([each.step(UP)[0]["achieved_goal"] for _ in range(6)])
        assert same(*trajectories)
        ends.add(tuple(np.round(trajectories[0][-1])))
    assert len(ends) > 1


# -- an agent ---------------------------------------------------------------------------------------------------------


def test_an_agent_learns_there_and_resumes(tmp_path: Path) -> None:
    whole = new_agent(gym.make(TELEPORT, max_steps=100)).learn(500)
    half = new_agent(gym.make(TELEPORT, max_steps=100)).learn(250)
    half.save(tmp_path / "agent")
    half.save_replay_buffer(tmp_path / "replay")
    resumed = type(half).load(tmp_path / "agent", env=gym.make(TELEPORT, max_steps=100))
    resumed.load_replay_buffer(tmp_path / "replay")
    resumed.learn(250, reset_num_timesteps=False)
    assert resumed.event_radius == 1.0
    assert differences(whole.graph.get_state(), resumed.graph.get_state()) == []
    assert differences(whole.parts.store.get_state(), resumed.parts.store.get_state()) == []
    assert len(whole.events) > 3


def test_episodes_begin_anywhere_if_asked_to() -> None:
    env = make(random_start=True)
    starts = np.array([env.reset(seed=0 if i == 0 else None)[0]["achieved_goal"] for i in range(20)])
    assert env.geometry.is_free(starts, 0.5).all()
    assert np.ptp(starts, axis=0).min() > 10.0
    chosen = env.reset(options={"start": starts[3]})[0]["achieved_goal"]
    np.testing.assert_allclose(chosen, starts[3])
    env.close()
