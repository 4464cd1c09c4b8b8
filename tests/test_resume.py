"""Learning that is broken off, saved, and taken up in another process ends exactly where unbroken learning ends."""

import warnings
from pathlib import Path
from typing import Any
from unittest import mock

import gymnasium as gym
import numpy as np
import pytest
from conftest import (
    POINT,
    TOY,
    Recorder,
    check_store,
    differences,
    in_new_process,
    new_agent,
    new_vec_env,
    state_in,
    state_of,
    without_clock,
)
from stable_baselines3 import SAC, TD3
from stable_baselines3.common.noise import OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.vec_env import SubprocVecEnv

from sb3_skillgraph import SkillGraphAgent
from sb3_skillgraph.hyperparams import load_hyperparams
from sb3_skillgraph.options.learner import OptionLearner

GO_ON = """
import sys
from conftest import new_vec_env
from sb3_skillgraph import SkillGraphAgent

folder, env_id, n_steps, max_steps = sys.argv[1], sys.argv[2], *map(int, sys.argv[3:])
for n_envs in (1, 2):
    env = new_vec_env(env_id, n_envs, max_steps=max_steps)
    agent = SkillGraphAgent.load(f"{folder}/half{n_envs}.zip", env=env)
    agent.load_replay_buffer(f"{folder}/half_replay{n_envs}.zip")
    agent.learn(n_steps, reset_num_timesteps=False)
    agent.save(f"{folder}/whole{n_envs}.zip")
    agent.save_replay_buffer(f"{folder}/whole_replay{n_envs}.zip")
"""


def go_on(agent: SkillGraphAgent, n_steps: int, folder: Path, env: Any) -> SkillGraphAgent:
    """Save, load, and learn on, in this process."""
    agent.save(folder / "half.zip")
    agent.save_replay_buffer(folder / "half_replay.zip")
    resumed = SkillGraphAgent.load(folder / "half.zip", env=env)
    resumed.load_replay_buffer(folder / "half_replay.zip")
    return resumed.learn(n_steps, reset_num_timesteps=False)


def check_equal(a: dict[str, Any], b: dict[str, Any]) -> None:
    assert differences(without_clock(a), without_clock(b)) == []


def check_new_process(folder: Path, env_id: str, n_steps: int, max_steps: int) -> list[SkillGraphAgent]:
    """Compare unbroken learning with learning that another process takes up, for one and for two environments."""
    agents, expected = [], []
    for n_envs in (1, 2):
        agents.append(new_agent(new_vec_env(env_id, n_envs, max_steps=max_steps)).learn(2 * n_steps))
        expected.append(state_of(agents[-1]))
        half = new_agent(new_vec_env(env_id, n_envs, max_steps=max_steps)).learn(n_steps)
        half.save(folder / f"half{n_envs}.zip")
        half.save_replay_buffer(folder / f"half_replay{n_envs}.zip")
    in_new_process(GO_ON, folder, env_id, n_steps, max_steps)
    for n_envs, state in zip((1, 2), expected, strict=True):
        check_equal(state, state_in(folder / f"whole{n_envs}.zip", folder / f"whole_replay{n_envs}.zip"))
    return agents


def test_new_process_ends_where_unbroken_learning_ends(tmp_path: Path) -> None:
    for agent in check_new_process(tmp_path, TOY, 851, max_steps=100):
        # It was put to the test with something to lose: walks that have been run.
        assert len(agent.options) > 8
        assert (agent.graph.edges.successes + agent.graph.edges.failures).any()


@pytest.mark.mujoco
def test_new_process_on_a_simulator(tmp_path: Path) -> None:
    for agent in check_new_process(tmp_path, POINT, 351, max_steps=150):
        assert agent.graph.edges.size


@pytest.mark.mujoco
def test_an_ant_with_the_shipped_settings(tmp_path: Path) -> None:
    settings = {**load_hyperparams("SkillGraph/AntUMaze-v0"), "learning_starts": 120, "batch_size": 32}
    del settings["n_timesteps"]

    def ant_env() -> gym.Env:
        return gym.make("SkillGraph/AntUMaze-v0", max_steps=80)

    whole = SkillGraphAgent(env=ant_env(), seed=0, **settings).learn(300)
    assert len(whole.options) > 1
    expected = state_of(whole)
    half = SkillGraphAgent(env=ant_env(), seed=0, **settings).learn(150)
    check_equal(expected, state_of(go_on(half, 150, tmp_path, ant_env())))


@pytest.mark.parametrize("n_steps", [1, 150, 263, 300])
def test_any_number_of_steps(tmp_path: Path, n_steps: int) -> None:
    # Before learning starts, in the middle of an episode, and at the end of one.
    expected = state_of(new_agent(gym.make(TOY)).learn(2 * n_steps))
    half = new_agent(gym.make(TOY)).learn(n_steps)
    check_equal(expected, state_of(go_on(half, n_steps, tmp_path, gym.make(TOY))))


def middle_of_what(agent: SkillGraphAgent) -> str:
    """What an agent with one environment is in the middle of."""
    rollout, (mission,) = agent.parts.rollout, agent.parts.missions.current
    if mission is None:
        return "nothing"
    if mission.random_walk:
        return "random walk"
    if rollout.hold_left[0]:
        return "random action"
    kind = "exploration" if mission.exploring else "way"
    return f"{'clean' if mission.clean else 'noisy'} {kind}"


def test_in_the_middle_of_anything(trained_files: tuple[Path, Path], tmp_path: Path) -> None:
    agent = SkillGraphAgent.load(trained_files[0], env=gym.make(TOY))
    agent.load_replay_buffer(trained_files[1])
    kinds = {f"{noise} {what}" for noise in ("clean", "noisy") for what in ("way", "exploration")}
    kinds |= {"random walk", "random action"}
    for _ in range(2_000):
        agent.learn(1, reset_num_timesteps=False, log_interval=None)
        if middle_of_what(agent) in kinds:
            kinds.remove(middle_of_what(agent))
            resumed = go_on(agent, 30, tmp_path, gym.make(TOY))
            agent.learn(30, reset_num_timesteps=False, log_interval=None)
            check_equal(state_of(agent), state_of(resumed))
        if not kinds:
            break
    assert not kinds


@pytest.mark.parametrize(
    "kwargs",
    [
        dict(train_freq=4, gradient_steps=2),
        dict(option_class=TD3),
        dict(option_class=SAC),
        dict(option_class="OptionTD3", shaping=1.0),
        dict(salience="dco"),
        dict(salience="rrt", explore_beyond=2.0),
        dict(max_events=8, buffer_size=150),
    ],
    ids=["train_freq", "TD3", "SAC", "OptionTD3", "dco", "rrt", "small"],
)
def test_with_other_arguments(tmp_path: Path, kwargs: dict[str, Any]) -> None:
    expected = state_of(new_agent(learning_starts=50, **kwargs).learn(402))
    half = new_agent(learning_starts=50, **kwargs).learn(201)
    check_equal(expected, state_of(go_on(half, 201, tmp_path, gym.make(TOY))))


@pytest.mark.parametrize("n_envs", [1, 2])
def test_noise_with_a_memory_of_its_own(tmp_path: Path, n_envs: int) -> None:
    def agent() -> SkillGraphAgent:
        noise = OrnsteinUhlenbeckActionNoise(np.zeros(2), 0.3 * np.ones(2))
        return new_agent(new_vec_env(n_envs=n_envs), action_noise=noise)

    expected = state_of(agent().learn(502))
    half = agent().learn(251)
    check_equal(expected, state_of(go_on(half, 251, tmp_path, new_vec_env(n_envs=n_envs))))


def test_environments_in_other_processes(tmp_path: Path) -> None:
    """They give what environments in this process give, to the last bit."""
    expected = state_of(new_agent(new_vec_env()).learn(602))
    half = new_agent(new_vec_env()).learn(301)
    env = new_vec_env(vec_env_cls=SubprocVecEnv)
    try:
        check_equal(expected, state_of(go_on(half, 301, tmp_path, env)))
        rrt = new_agent(env, salience="rrt", learning_starts=50).learn(200)  # its oracle is asked in another process
        assert rrt.num_timesteps == 200
    finally:
        env.close()


def test_environment_given_later(tmp_path: Path) -> None:
    expected = state_of(new_agent().learn(602))
    half = new_agent().learn(301)
    half.save(tmp_path / "half")
    half.save_replay_buffer(tmp_path / "half_replay")
    resumed = SkillGraphAgent.load(tmp_path / "half")
    resumed.load_replay_buffer(tmp_path / "half_replay")
    resumed.set_env(gym.make(TOY), force_reset=False)
    check_equal(expected, state_of(resumed.learn(301, reset_num_timesteps=False)))


def test_environment_given_later_begins_a_fresh_episode(tmp_path: Path) -> None:
    new_agent().learn(301).save(tmp_path / "half")
    resumed = SkillGraphAgent.load(tmp_path / "half")
    env = Recorder(gym.make(TOY))
    resumed.set_env(env)
    resumed.learn(50, reset_num_timesteps=False)
    np.testing.assert_array_equal(env.transitions[0]["achieved_goal"], env.starts[0])


def test_in_three_parts_without_files() -> None:
    expected = state_of(new_agent().learn(600))
    parts = new_agent().learn(200)
    for _ in range(2):
        parts.learn(200, reset_num_timesteps=False)
    check_equal(expected, state_of(parts))


def test_saving_a_loaded_agent_again_changes_nothing(trained_files: tuple[Path, Path]) -> None:
    agent = SkillGraphAgent.load(trained_files[0], env=gym.make(TOY))
    agent.load_replay_buffer(trained_files[1])
    assert differences(state_in(*trained_files), state_of(agent)) == []


def test_force_reset_begins_an_episode(trained_files: tuple[Path, Path]) -> None:
    env = Recorder(gym.make(TOY))
    agent = SkillGraphAgent.load(trained_files[0], env=env, force_reset=True)
    agent.learn(50, reset_num_timesteps=False)
    assert len(env.starts) == 1
    np.testing.assert_array_equal(env.transitions[0]["achieved_goal"], env.starts[0])


def test_starting_over_forgets_where_the_saved_environment_stood(trained_files: tuple[Path, Path]) -> None:
    env = Recorder(gym.make(TOY, max_steps=1000))
    agent = SkillGraphAgent.load(trained_files[0], env=env)
    agent.learn(150, log_interval=None)
    agent.learn(150, log_interval=None, reset_num_timesteps=False)
    # One episode of 300 steps: the second call goes on where the first stopped.
    assert len(env.starts) == 1
    check_store(agent, env.transitions)


def test_going_on_with_the_other_update_is_told(trained_files: tuple[Path, Path]) -> None:
    """Whose numbers differ in the last digits, so that learning is not exactly what it would have been."""
    agent = SkillGraphAgent.load(trained_files[0], env=gym.make(TOY))
    agent.load_replay_buffer(trained_files[1])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        agent.learn(10, reset_num_timesteps=False)
    agent = SkillGraphAgent.load(trained_files[0], env=gym.make(TOY))
    agent.load_replay_buffer(trained_files[1])
    told = pytest.warns(UserWarning, match="trained by the kernel update and goes on with the reference update")
    with mock.patch.object(OptionLearner, "_why_reference", lambda learner: "no reason"), told:
        agent.learn(10, reset_num_timesteps=False)


@pytest.mark.parametrize("n_envs", [1, 3])
def test_other_number_of_environments(trained_files: tuple[Path, Path], n_envs: int) -> None:
    agent = SkillGraphAgent.load(trained_files[0], env=new_vec_env(n_envs=n_envs))
    total = agent.num_timesteps
    agent.learn(300, reset_num_timesteps=False)
    assert agent.num_timesteps == total + 300
    assert agent.parts.store.total == 300


def test_environment_that_cannot_tell_its_state(tmp_path: Path) -> None:
    class Closed(gym.Wrapper):
        def get_wrapper_attr(self, name: str) -> Any:
            if name in ("get_state", "set_state"):
                raise AttributeError(name)
            return super().get_wrapper_attr(name)

        def has_wrapper_attr(self, name: str) -> bool:
            return name not in ("get_state", "set_state") and super().has_wrapper_attr(name)

    half = new_agent(Closed(gym.make(TOY))).learn(250)
    env = Recorder(Closed(gym.make(TOY)))
    resumed = go_on(half, 250, tmp_path, env)
    assert resumed.num_timesteps == resumed.parts.store.total == 500
    assert len(env.transitions) == 250
    np.testing.assert_array_equal(env.transitions[0]["achieved_goal"], env.starts[0])
