"""A policy over options, one environment step at a time."""

from typing import Any

import numpy as np
from stable_baselines3.common.type_aliases import PolicyPredictor

from sb3_skillgraph.smdp.actions import Running
from sb3_skillgraph.smdp.options_env import MASK, OptionsEnv


class FlatPolicy:
    """
    Acts in the wrapped environment of an :class:`~sb3_skillgraph.OptionsEnv` as its high level would have it.

    :param high_level: chooses options: SB3's ``predict`` on the observations of an ``OptionsEnv``
    :param env: knows how options run; it is not stepped
    """

    def __init__(self, high_level: PolicyPredictor, env: OptionsEnv) -> None:
        self.high_level = high_level
        self.env = env

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
        """
        Act, and choose an option where the last one has ended.

        :param observation: one observation of the wrapped environment
        :param state: what the last call returned: the running option, its steps, the high level's own state, and what
            the options remember
        :param episode_start: where an episode begins, and the state is forgotten; shape ``(1,)``
        :param deterministic: passed to the high level
        :return: the action, and the state
        """
        assert isinstance(observation, dict)
        run: Running | None = None
        steps, memory = 0, None
        if state is not None and not (episode_start is not None and np.any(episode_start)):
            run, steps, memory, self.env.actions.state = state[0].item(), int(state[1][0]), state[2].item(), state[3].item()
        else:
            self.env.actions.reset(observation)
        if run is not None and self.env.outcome(run, observation, steps) is not None:
            run, steps = None, 0
        if run is None:
            seen = {**observation, MASK: self.env.masks_at(observation).astype(np.int8)}
            action, memory = self.high_level.predict(seen, memory, None, deterministic)
            run = self.env.begin(observation, int(action))
        action = self.env.act(run, observation)
        return action, (boxed(run), np.array([steps + 1]), boxed(memory), boxed(self.env.actions.state))


def boxed(item: Any) -> np.ndarray:
    """Put anything into an array of shape (1,): SB3's states are tuples of arrays."""
    box = np.empty(1, dtype=object)
    box[0] = item
    return box
