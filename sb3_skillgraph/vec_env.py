"""SB3's vector of environments without its copies."""

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn


class LeanVecEnv(DummyVecEnv):
    """A ``DummyVecEnv`` of goal environments that hands each step's observations and infos on as they are.

    Its parent copies both twice, so that environments may use their own arrays and infos again: more work than a point
    mass is to simulate. Here the observations are copied once, and infos are those of the environments: whoever keeps
    an info for longer than a step copies it.

    :param envs: the environments, with Dict observations
    """

    def __init__(self, envs: list[gym.Env]) -> None:
        super().__init__([lambda env=env: env for env in envs])  # type: ignore[misc]
        assert isinstance(self.observation_space, spaces.Dict)
        self._dtypes = {key: space.dtype for key, space in self.observation_space.spaces.items()}

    def step_wait(self) -> VecEnvStepReturn:
        """Step every environment, and reset those whose episode has ended.

        :return: observations, rewards, dones and infos, as every VecEnv returns them
        """
        observations, rewards, dones, infos = [], [], [], []
        for i, env in enumerate(self.envs):
            observation, reward, terminated, truncated, info = env.step(self.actions[i])
            done = terminated or truncated
            info["TimeLimit.truncated"] = truncated and not terminated
            if done:
                info["terminal_observation"] = observation
                observation, self.reset_infos[i] = env.reset()
            observations.append(observation)
            rewards.append(reward)
            dones.append(done)
            infos.append(info)
        stacked = {key: np.array([o[key] for o in observations], dtype=dtype) for key, dtype in self._dtypes.items()}
        return stacked, np.array(rewards, dtype=np.float32), np.array(dones, dtype=bool), infos
