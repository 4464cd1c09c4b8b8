"""SB3's vector of environments without its copies."""

from typing import Any

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
        self._boxes = {key: (box.dtype, (len(envs), *(box.shape or ()))) for key, box in self.observation_space.spaces.items()}

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
        return self._stacked(observations), np.array(rewards, dtype=np.float32), np.array(dones, dtype=bool), infos

    def _stacked(self, observations: list[Any]) -> dict[str, np.ndarray]:
        stacked = {}
        for key, (dtype, shape) in self._boxes.items():
            try:
                stacked[key] = np.array([observation[key] for observation in observations], dtype=dtype)
            except (KeyError, TypeError, ValueError) as error:
                raise ValueError(f"The environment's observation has no such {key!r} as its space says: {error!r}.") from error
            if stacked[key].shape != shape:
                raise ValueError(
                    f"The environment's observation has a {key!r} of shape {stacked[key].shape[1:]}, and its space says "
                    f"{shape[1:]}."
                )
        return stacked

    def _save_obs(self, env_idx: int, obs: Any) -> None:
        """Keep what a reset has shown, as the parent does, if it is what the space says."""
        for key, values in self._stacked([obs] * len(self.envs)).items():
            self.buf_obs[key][env_idx] = values[0]
