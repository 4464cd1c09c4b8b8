"""How episodes end and begin while learning: agents that are stuck, starts that are given."""

import copy
import functools
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import compress
from typing import Any

import numpy as np
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

#: What an environment may tell in ``info`` where it ends an episode, by the names in use.
EXPLAINED = ("stuck", "success", "is_success")


class Episodes:
    """Ends the episodes of agents that are stuck, and begins all where they are to begin.

    :param agent: whose environments they are
    """

    def __init__(self, agent: OffPolicyAlgorithm) -> None:
        self.agent = agent
        self.reset_options: dict[str, Any] = {}  # while adapting: where episodes start

    @contextmanager
    def starting_with(self, reset_options: dict[str, Any]) -> Iterator[None]:
        """Begin all episodes with the same options of ``reset``.

        :param reset_options: of all resets in the block
        """
        assert self.agent.env is not None
        self.reset_options = reset_options
        try:
            self.agent.env.set_options(reset_options)
            yield
        finally:
            self.reset_options = {}
            self.agent.env.set_options()

    def terminated(self, dones: np.ndarray, infos: list[dict[str, Any]]) -> np.ndarray:
        """Tell which environments have ended for good; a time limit is no such end.

        :param dones: which episodes have ended, shape ``(n_envs,)``
        :param infos: the VecEnv's infos
        """
        if not dones.any():
            return dones.copy()
        terminated = dones & ~np.array([info.get("TimeLimit.truncated", False) for info in infos])
        if any(not any(info.get(why) for why in EXPLAINED) for info in compress(infos, terminated)):
            _warn_of_ends()
        return terminated

    def start_over(
        self, new_obs: dict[str, np.ndarray], dones: np.ndarray, stuck: np.ndarray, infos: list[dict[str, Any]]
    ) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
        """Give up the episodes of agents that are stuck, and begin all where they are to begin while adapting.

        :param new_obs: what the VecEnv returned
        :param dones: which episodes have ended; those given up are added in place, since SB3 counts by this array
        :param stuck: which agents can do nothing any more
        :param infos: the VecEnv's infos; those of episodes given up gain what SB3 looks for at an episode's end
        :return: the observations that go on from here, and those that the step led to: the last ones of episodes that ended
        """
        env = self.agent.env
        assert env is not None
        given_up = stuck & ~dones
        dones |= given_up
        if not dones.any():
            return new_obs, new_obs
        reached = {key: np.array(value) for key, value in new_obs.items()}
        new_obs = copy.deepcopy(reached)
        for i in np.flatnonzero(dones).tolist():
            if given_up[i]:
                infos[i]["terminal_observation"] = {key: value[i] for key, value in reached.items()}
                self._count(env, i, infos[i])
            else:
                for key in reached:
                    reached[key][i] = infos[i]["terminal_observation"][key]
            if given_up[i] or self.reset_options:  # the VecEnv's own resets know no options
                observation, _ = env.env_method("reset", options=self.reset_options or None, indices=i)[0]
                for key in new_obs:
                    new_obs[key][i] = observation[key]
        return new_obs, reached

    def _count(self, env: VecEnv, i: int, info: dict[str, Any]) -> None:
        """Let SB3's statistics know of an episode that is given up: its Monitor counts only those that end."""
        if env.env_is_wrapped(Monitor, indices=i)[0]:
            rewards = env.get_attr("rewards", indices=i)[0]
            seconds = time.time() - env.get_attr("t_start", indices=i)[0]
            info["episode"] = {"r": round(sum(rewards), 6), "l": len(rewards), "t": round(seconds, 6)}
            self.agent._update_info_buffer([info], np.ones(1, dtype=bool))


@functools.cache
def _warn_of_ends() -> None:
    warnings.warn(
        "The environment ended an episode (terminated) without telling success or, in info['stuck'], that the agent can do "
        "nothing any more. An end as such costs options nothing, so that they learn to seek it: where it is a failure, let "
        "the environment tell, for example with TellStuck.",
        stacklevel=4,
    )
