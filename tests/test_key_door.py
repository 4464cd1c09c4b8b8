"""The maze with a key and a door: what can be done, what cannot be undone, and what a graph makes of it."""

import pickle
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.env_checker import check_env

from sb3_skillgraph import SkillGraphAgent, evaluate_pairs
from sb3_skillgraph.envs.key_door import KEY_DOOR_MAZE, PointKeyDoorEnv

ID = "SkillGraph/PointKeyDoor-v0"
#: Cells from the start to the door, from there to the key and back, and behind the door.
TO_DOOR = [(4, 1), (3, 1), (3, 2), (3, 3)]
TO_KEY = [(2, 3), (1, 3), (1, 2), (1, 1)]
BEHIND = [(3, 4), (3, 5), (2, 5)]


@pytest.fixture
def env() -> PointKeyDoorEnv:
    env: Any = gym.make(ID).unwrapped
    env.reset(seed=0)
    return env


def drive(env: PointKeyDoorEnv, cells: list[tuple[int, int]], n_steps: int = 150) -> np.ndarray:
    """Push the ball from cell to cell; return the goal achieved."""
    observation = env._observe()
    for cell in cells:
        aim = env.geometry.cell_to_xy(*cell)
        for _ in range(n_steps):
            place, velocity = observation["observation"][:2], observation["observation"][4:]
            observation = env.step(np.clip(6.0 * (aim - place) - 1.5 * velocity, -1.0, 1.0).astype(np.float32))[0]
            if np.linalg.norm(observation["achieved_goal"][:2] - aim) < 0.1:
                break
    return observation["achieved_goal"]


def test_the_door_opens_only_with_the_key_and_neither_is_undone(env: PointKeyDoorEnv) -> None:
    assert drive(env, TO_DOOR)[2:].tolist() == [0.0, 0.0]
    shut = drive(env, [(3, 4)])
    assert shut[2:].tolist() == [0.0, 0.0]
    assert shut[0] < -0.5  # before the door
    assert drive(env, [(3, 3), *TO_KEY])[2:].tolist() == [1.0, 0.0]
    assert drive(env, [*TO_KEY[::-1], (3, 3)])[2] == 1.0
    through = drive(env, BEHIND)
    assert through[2:].tolist() == [1.0, 1.0]
    np.testing.assert_allclose(through[:2], env.geometry.cell_to_xy(2, 5), atol=0.15)
    assert drive(env, [(3, 5), (3, 4), (3, 3), (3, 2)])[2:].tolist() == [1.0, 1.0]


def test_a_goal_wants_place_key_and_door(env: PointKeyDoorEnv) -> None:
    here = env.geometry.cell_to_xy(5, 1)
    for flags, reached in (((0, 0), True), ((1, 0), False), ((1, 1), False)):
        _, info = env.reset(options={"start": here, "goal": [*here, *flags]})
        assert info["success"] == reached
    achieved, wanted = np.array([[*here, 0, 0], [*here, 1, 0]]), np.tile([*here, 1.0, 0.0], (2, 1))
    assert env.compute_reward(achieved, wanted, {}).tolist() == [0.0, 1.0]


def test_goals_are_drawn_from_what_can_be_achieved(env: PointKeyDoorEnv) -> None:
    rng = np.random.default_rng(0)
    goals = np.array([env.sample_free(rng) for _ in range(600)])
    far = goals[:, 0] > 0.6
    assert 0.3 < far.mean() < 0.7
    assert (goals[far, 2:] == 1.0).all()
    kinds, counts = np.unique(goals[~far, 2:], axis=0, return_counts=True)
    assert kinds.tolist() == [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]]
    assert counts.min() > 50


@pytest.mark.parametrize(
    "options",
    [
        {"goal": [-3.0, -2.0]},
        {"goal": [-3.0, -2.0, 0.0, 1.0]},
        {"goal": [-3.0, -2.0, 0.5, 0.0]},
        {"goal": [3.0, -2.0, 1.0, 0.0]},
        {"start": [3.0, -2.0]},
        {"start": [0.0, 0.0, 1.0, 0.0]},
        {"start": "here"},
    ],
    ids=str,
)
def test_what_cannot_be(env: PointKeyDoorEnv, options: Any) -> None:
    with pytest.raises(ValueError, match="reset option"):
        env.reset(options=options)


@pytest.mark.parametrize("mark", ["k", "d"])
def test_a_map_without_a_key_or_a_door(mark: str) -> None:
    maze_map = [[0 if cell == mark else cell for cell in row] for row in KEY_DOOR_MAZE]
    with pytest.raises(ValueError, match=f"one cell '{mark}'"):
        gym.make(ID, maze_map=maze_map)


def test_key_and_door_belong_to_the_state(env: PointKeyDoorEnv) -> None:
    drive(env, [*TO_DOOR, *TO_KEY, *TO_KEY[::-1], (3, 3), (3, 4)])
    other: Any = gym.make(ID).unwrapped
    other.reset(seed=5)
    other.set_state(env.get_state())
    copied = pickle.loads(pickle.dumps(env))
    ends = [drive(one, [(3, 5)]) for one in (env, other, copied)]
    assert ends[0][:2] == pytest.approx(env.geometry.cell_to_xy(3, 5), abs=0.15)
    np.testing.assert_array_equal(ends[1], ends[0])
    np.testing.assert_array_equal(ends[2], ends[0])
    env.reset()
    assert drive(env, [*TO_DOOR, (3, 4)])[0] < -0.5  # a new episode begins with a door that is shut


def test_it_is_an_environment(env: PointKeyDoorEnv) -> None:
    check_env(env)


@pytest.fixture(scope="module")
def trained() -> SkillGraphAgent:
    agent = SkillGraphAgent("MultiInputPolicy", gym.make(ID), seed=0)
    return agent.learn(30_000)


def test_no_event_joins_places_with_and_without_the_key(trained: SkillGraphAgent) -> None:
    flags = trained.graph.centers[:, 2:]
    assert {tuple(row) for row in flags.tolist()} == {(0.0, 0.0), (1.0, 0.0), (1.0, 1.0)}
    edges = trained.graph.edges
    losing = (flags[edges.source] > flags[edges.target]).any(axis=1)
    assert losing.any()
    assert not edges.forward[losing].any()  # nobody ever lost a key


def test_plans_to_behind_the_door_go_by_the_key(trained: SkillGraphAgent) -> None:
    env = gym.make(ID)
    events = {event.id: event.center for event in trained.events}
    observation, _ = env.reset(seed=0, options={"goal": [1.0, 2.0, 1.0, 1.0]})
    path = [events[id] for id in trained.plan(observation).path if id in events]
    flags = [tuple(center[2:]) for center in path]
    assert flags == sorted(flags)
    assert {(0.0, 0.0), (1.0, 0.0), (1.0, 1.0)} <= set(flags)
    with_key = next(center for center in path if center[2])
    assert np.linalg.norm(with_key[:2] - [-3.0, 2.0]) < 0.7
    assert evaluate_pairs(trained, ID, n_pairs=30).success_rate >= 0.6
