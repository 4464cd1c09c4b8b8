"""The agent's own VecEnv gives what SB3's gives."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from conftest import SMALL, TOY
from gymnasium import spaces
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_skillgraph import SkillGraphAgent
from sb3_skillgraph.vec_env import LeanVecEnv


def make() -> gym.Env:
    return Monitor(gym.make(TOY, max_steps=7))


def same(a: Any, b: Any) -> bool:
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    return bool(np.array_equal(a, b)) and np.asarray(a).dtype == np.asarray(b).dtype


def test_steps_are_those_of_sb3() -> None:
    stock, lean = DummyVecEnv([make, make, make]), LeanVecEnv([make(), make(), make()])
    for env in (stock, lean):
        env.seed(3)
    assert same(stock.reset(), lean.reset())
    rng = np.random.default_rng(0)
    for _ in range(20):
        actions = rng.uniform(-1, 1, (3, 2)).astype(np.float32)
        (obs, rewards, dones, infos), (our_obs, our_rewards, our_dones, our_infos) = stock.step(actions), lean.step(actions)
        assert same(obs, our_obs)
        assert same(rewards, our_rewards)
        assert same(dones, our_dones)
        for info, ours in zip(infos, our_infos, strict=True):
            episode, our_episode = info.pop("episode", None), ours.pop("episode", None)
            assert (episode is None) == (our_episode is None)
            if episode is not None:
                assert (episode["r"], episode["l"]) == (our_episode["r"], our_episode["l"])
            assert same(info, ours)
    assert same(stock.reset_infos, lean.reset_infos)


def test_observations_of_one_step_are_not_those_of_the_next() -> None:
    class Frugal(gym.Env):
        """Uses its arrays again, as Gymnasium allows."""

        observation_space = spaces.Dict(
            {key: spaces.Box(-9, 9, (1,)) for key in ("observation", "achieved_goal", "desired_goal")}
        )
        action_space = spaces.Box(-1, 1, (1,))

        def __init__(self) -> None:
            self.array = np.zeros(1, dtype=np.float32)

        def reset(self, **_: Any) -> Any:
            self.array[:] = 0
            return dict.fromkeys(self.observation_space, self.array), {}

        def step(self, action: Any) -> Any:
            self.array += 1
            return dict.fromkeys(self.observation_space, self.array), 0.0, False, False, {}

    env = LeanVecEnv([Frugal()])
    env.reset()
    first, *_ = env.step(np.zeros((1, 1)))
    second, *_ = env.step(np.zeros((1, 1)))
    assert (float(first["observation"][0, 0]), float(second["observation"][0, 0])) == (1.0, 2.0)


def test_the_agent_wraps_what_is_no_vec_env_yet() -> None:
    for env, kind in ((gym.make(TOY), LeanVecEnv), (DummyVecEnv([make]), DummyVecEnv)):
        vec_env = SkillGraphAgent("MultiInputPolicy", env, **SMALL).get_env()
        assert isinstance(vec_env, VecEnv)
        assert type(vec_env) is kind


def test_processes_that_never_imported_us_find_our_environments(tmp_path: Path) -> None:
    """Gymnasium has no plugins: the package that an id names before its colon is imported where the environment is made."""
    script = tmp_path / "script.py"
    script.write_text(
        """
import sys

from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import SubprocVecEnv

if __name__ == "__main__":
    env = make_vec_env("sb3_skillgraph:SkillGraph/ToyMaze-v0", 2, vec_env_cls=SubprocVecEnv)
    assert env.reset()["achieved_goal"].shape == (2, 2)
    assert "sb3_skillgraph" not in sys.modules
    env.close()
"""
    )
    subprocess.run([sys.executable, str(script)], check=True)
