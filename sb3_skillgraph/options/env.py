"""An environment for one option by itself."""

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_skillgraph.events import Event
from sb3_skillgraph.memory.replay import OptionRule
from sb3_skillgraph.options.initiation import InitiationSet
from sb3_skillgraph.options.option import Option
from sb3_skillgraph.options.views import ScaledView, View, as_view
from sb3_skillgraph.options.walk import Walk


class OptionEnv(gym.Wrapper):
    """A goal environment with the reward and the end of one option (section 2.1).

    ``DDPG("MlpPolicy", OptionEnv(env, event)).learn(10_000)`` trains a policy for the option by itself. The reward is -1
    a step and 0 on reaching the termination set, which ends the episode; after ``timeout`` steps it is truncated. An
    agent that is stuck (``info["stuck"]``) ends it too, and pays -100: a hundred steps' worth, or for ever at 0.99. The
    next episode of the option goes on where the last one ended: the wrapped environment is reset only when its own
    episode is over or has not begun.

    :param env: a goal environment (Dict observations, Box actions)
    :param termination: the event the option leads to, a walk to it, or the option into whose initiation set it leads
    :param initiation: where the option can start; ``info["can_start"]`` tells after each reset whether it can
    :param timeout: environment steps per run
    :param goal: the point the policy aims at, shape ``(goal_dim,)``; by default that of the termination set
    :param option_view: what the policy sees, as :class:`~sb3_skillgraph.SkillGraphAgent` takes it; by default what the
        environment names as its ``option_view``, else ``"relative"``
    :raises ValueError: if the environment is no goal environment, the goal has the wrong shape, or the view is unknown

    >>> option = OptionEnv(gym.make("SkillGraph/ToyMaze-v0"), Event("corner", np.array([1.0, 1.0]), 0.3))
    >>> observation, info = option.reset(seed=0)
    >>> option.observation_space.contains(observation)
    True
    """

    def __init__(
        self,
        env: gym.Env,
        termination: Event | Option | Walk,
        *,
        initiation: InitiationSet | None = None,
        timeout: int = 200,
        goal: np.ndarray | None = None,
        option_view: str | View | None = None,
    ) -> None:
        super().__init__(env)
        space = env.observation_space
        if not isinstance(space, spaces.Dict) or "achieved_goal" not in space.spaces:
            raise ValueError(
                f"OptionEnv needs a goal environment: a Dict observation with 'observation', 'achieved_goal' and "
                f"'desired_goal', not {space}."
            )
        if isinstance(termination, Walk):
            termination = termination.termination
        self.termination = termination
        self.initiation = initiation
        self.timeout = timeout
        if goal is None:
            goal = termination.initiation.core if isinstance(termination, Option) else termination.center
        self.goal = np.asarray(goal, dtype=np.float32)
        if self.goal.shape != space["achieved_goal"].shape:
            raise ValueError(f"The goal must have shape {space['achieved_goal'].shape}, not {self.goal.shape}.")
        if option_view is None and env.has_wrapper_attr("option_view"):
            option_view = env.get_wrapper_attr("option_view")
        self.view = ScaledView(as_view(option_view), termination.metric)
        self.rule = OptionRule(termination.metric, termination=termination)
        dims = [int(np.prod(space[key].shape)) for key in ("observation", "achieved_goal")]  # type: ignore[arg-type]
        self.observation_space = spaces.Box(-np.inf, np.inf, (self.view.dim(*dims),), np.float32)
        self._last: dict[str, np.ndarray] | None = None
        self._steps = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin a run of the option where the last one ended.

        :param seed: seeds the wrapped environment, which is then reset
        :param options: passed to the wrapped environment, which is then reset
        :return: what the policy sees, and ``info`` with ``can_start``
        """
        info: dict[str, Any] = {}
        if self._last is None or seed is not None or options is not None:
            self._last, info = self.env.reset(seed=seed, options=options)
        self._steps = 0
        point = np.asarray(self._last["achieved_goal"])[None]
        info["can_start"] = self.initiation is None or bool(self.initiation.optimistic(point)[0])
        return self._see(self._last), info

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Take one step; the reward and the end are the option's.

        :param action: action of the wrapped environment
        :return: what the policy sees, reward, whether the option succeeded, whether it was cut off, info
        """
        assert self._last is not None, "Call reset before step."
        observation, _, terminated, truncated, info = self.env.step(action)
        self._steps += 1
        stuck = bool(info.get("stuck"))
        success = not stuck and self.termination.holds(np.asarray(observation["achieved_goal"]))
        over = success or stuck or terminated
        before, after = (np.asarray(each["achieved_goal"])[None] for each in (self._last, observation))
        reached, ended, lost = np.array([[success], [over], [stuck]])
        reward = float(self.rule.reward(reached, ended, lost, before, after, self.goal[None])[0])
        self._last = None if stuck or terminated or truncated else observation
        cut = not (success or stuck) and (self._steps >= self.timeout or truncated)
        return self._see(observation), reward, over, cut, {**info, "is_success": success}

    def _see(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        rows = [np.asarray(observation[key], dtype=np.float32).reshape(1, -1) for key in ("observation", "achieved_goal")]
        return self.view(rows[0], rows[1], self.goal[None])[0]
