"""A goal environment lifted into an SMDP: one action is one run of an option (section 2.1)."""

import math
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_skillgraph.options.option import Option
from sb3_skillgraph.options.walk import Walk, Walks
from sb3_skillgraph.smdp.actions import OptionActions, Running, WalkActions

MASK = "action_mask"
MOST_AXES = 2  # up to so many dimensions of actions, primitive actions push along each axis
N_OPTIONS = 64  # actions, where nothing is said


class OptionsEnv(gym.Wrapper):
    """
    An environment whose actions are options.

    Action ``i`` runs ``options[i]`` until it reaches its termination set, its time is up or the episode ends. The last actions
    can always be taken: the walk straight to the goal, if there is one, then primitive actions, which take one step. The
    reward is the discounted sum of the rewards on the way, and ``info`` has ``tau`` (environment steps taken), ``discount``
    (``gamma ** tau``), ``option`` (id) and ``option_success``.

    Observations gain an entry ``action_mask``, which :meth:`action_masks` returns as well: an option may run if it can start.
    There may be more options with time; no action ever changes its meaning, and those of options still unborn, or gone, are
    masked. (Another environment, made after events of the agent's graph were merged, numbers its walks anew.)

    Where the agent gets stuck (``info["stuck"]``) the episode is over, and costs are added up as if it stood there for
    ever. A ``Monitor`` belongs around this environment, not into it: from inside it does not see such an end.

    :param env: a goal environment (Dict observations, Box actions)
    :param options: an agent's options, ``agent.options``: its walks, run as ``agent.predict`` runs them, and the walk
        straight to the goal. Or options with policies and initiation sets of their own, which can be taken where they are
        mature, stand in their (optimistic) initiation set and not yet in their termination set
    :param global_option: the option of that kind that walks to any goal
    :param primitives: actions scaled to [-1, 1], shape ``(n, action_dim)``; None takes both directions of every axis and
        standing still where actions have at most two dimensions, else one step of the walk straight to the goal
    :param max_options: number of actions: room for options and primitive actions; by default 64, or for twice as many walks as
        the agent's graph holds, since new events may take the place of merged ones
    :param gamma: discount factor per environment step
    :param timeout: environment steps an option may run; the global option, half of them. An agent's walks have times of
        their own
    :raises ValueError: if the environment is no goal environment, nothing can always be done, or there is too little room

    >>> env = gym.make("SkillGraph/ToyMaze-v0")
    >>> agent = SkillGraphAgent("MultiInputPolicy", env, seed=0).learn(300)
    >>> options = OptionsEnv(env, agent.options)
    >>> observation, _ = options.reset(seed=0)
    >>> can_run = np.flatnonzero(observation["action_mask"])
    >>> _, reward, _, _, info = options.step(can_run[0])
    >>> info["tau"] >= 1
    True
    """

    def __init__(
        self,
        env: gym.Env,
        options: Sequence[Option] | Sequence[Walk],
        *,
        global_option: Option | None = None,
        primitives: np.ndarray | None = None,
        max_options: int | None = None,
        gamma: float = 0.99,
        timeout: int = 200,
    ) -> None:
        super().__init__(env)
        inner = env.observation_space
        if not isinstance(inner, spaces.Dict) or "desired_goal" not in inner.spaces:
            raise ValueError(f"OptionsEnv needs a goal environment with Dict observations, not {inner}.")
        if not isinstance(env.action_space, spaces.Box):
            raise ValueError(f"OptionsEnv needs an environment with Box actions, not {env.action_space}.")
        self.options = options
        self.gamma = gamma
        self.timeout = timeout
        self.actions = _actions(options, global_option, timeout)
        self.primitives = self._find_primitives(env.action_space, primitives)
        # Always to be taken: the walk straight to the goal if there is one, and primitives
        self.n_fixed = len(self.primitives) + self.actions.has_direct
        if max_options is None:
            max_options = N_OPTIONS
            if isinstance(self.actions, WalkActions):
                max_options = 2 * self.actions.runner.graph.max_events + self.n_fixed
        self.max_options = max_options
        self.first_fixed = max_options - self.n_fixed
        self.action_space = spaces.Discrete(max_options)
        self.observation_space = spaces.Dict({**inner.spaces, MASK: spaces.MultiBinary(max_options)})
        self._inner_space = env.action_space
        self._last: dict[str, np.ndarray] | None = None
        self._check_room()

    def _find_primitives(self, space: spaces.Box, given: np.ndarray | None) -> list[np.ndarray | None]:
        dim = int(np.prod(space.shape))
        if given is not None:
            primitives: list[np.ndarray | None] = list(np.asarray(given, dtype=np.float32).reshape(-1, dim))
        elif dim <= MOST_AXES:
            axes = np.eye(dim, dtype=np.float32)
            primitives = [*axes, *-axes, np.zeros(dim, dtype=np.float32)]
        else:
            primitives = [None] if self.actions.has_direct else []  # one step of the walk straight to the goal
        if not primitives and not self.actions.has_direct:
            raise ValueError(
                "There are neither primitive actions nor a global option, so that there could be places where nothing can "
                "be done: give a global_option."
            )
        return primitives

    def _check_room(self) -> int:
        """Return how many options there are, if they have room."""
        n_options = self.actions.n()
        if n_options > self.first_fixed:
            needed = n_options + self.n_fixed
            raise ValueError(
                f"{n_options} options and {self.n_fixed} actions that can always be taken do not fit into "
                f"max_options={self.max_options}: give max_options={2 ** math.ceil(math.log2(needed))}."
            )
        return n_options

    @property
    def global_action(self) -> int:
        """Index of the walk straight to the goal.

        :raises ValueError: if there is none
        """
        if not self.actions.has_direct:
            raise ValueError("There is no global option: OptionsEnv(..., global_option=...).")
        return self.first_fixed

    def index(self, option: str) -> int:
        """Return an option's action.

        :param option: its id
        :raises KeyError: if there is none of that name
        """
        action = self.actions.action_of(option)
        return self.global_action if action is None else action

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Begin an episode.

        :param seed: seeds the wrapped environment
        :param options: passed to the wrapped environment
        :return: observation and info
        """
        observation, info = self.env.reset(seed=seed, options=options)
        self.actions.reset(observation)
        return self._see(observation), info

    def action_masks(self) -> np.ndarray:
        """Tell which actions can be taken now, under sb3-contrib's name for it.

        :return: bool array of shape ``(max_options,)``, never all False
        :raises ValueError: before the first ``reset``, or if the options have outgrown ``max_options``
        """
        if self._last is None:
            raise ValueError("Call reset before action_masks: which options can start depends on where the agent stands.")
        return self.masks_at(self._last)

    def masks_at(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        """Tell which actions can be taken.

        :param observation: of the wrapped environment
        :return: bool array of shape ``(max_options,)``, never all False
        """
        n_options = self._check_room()
        mask = np.zeros(self.max_options, dtype=bool)
        mask[:n_options] = self.actions.masks(observation)
        mask[self.first_fixed :] = True
        return mask

    def step(self, action: int | np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Run an option.

        :param action: its index
        :return: observation, discounted sum of rewards, terminated, truncated, info
        :raises ValueError: if the action is masked
        """
        if not (0 <= action < self.max_options and self.action_masks()[int(action)]):
            raise ValueError(f"Action {action} cannot be taken here: see action_masks().")
        assert self._last is not None
        run = self.begin(self._last, int(action))
        total, discount, tau = 0.0, 1.0, 0
        while True:
            observation, reward, terminated, truncated, info = self.env.step(self.act(run, self._last))
            self._last = observation
            total += discount * float(reward)
            discount *= self.gamma
            tau += 1
            stuck = bool(info.get("stuck"))
            success = self.outcome(run, observation, tau, stuck)
            if stuck:
                terminated = True
                total += discount * min(float(reward), 0.0) / max(1.0 - self.gamma, 1e-3)
            if success is not None or terminated or truncated:
                break
        info = {**info, "tau": tau, "discount": discount, "option": run.id, "option_success": bool(success)}
        return self._see(observation), total, terminated, truncated, info

    def begin(self, observation: dict[str, np.ndarray], action: int) -> Running:
        """Begin to execute an action.

        :param observation: of the wrapped environment
        :param action: its index
        """
        if action < self.first_fixed:
            return self.actions.begin(observation, action)
        index = action - self.max_options + len(self.primitives)
        if index < 0:
            return self.actions.begin(observation, None)
        primitive = self.primitives[index]
        if primitive is None:
            return self.actions.begin(observation, None)._replace(id=f"primitive {index}", timeout=1.0, single=True)
        return Running(f"primitive {index}", None, primitive, np.asarray(observation["desired_goal"]), 1.0, single=True)

    def act(self, run: Running, observation: dict[str, np.ndarray]) -> np.ndarray:
        """Return what a running option does.

        :param run: what :meth:`begin` returned
        :param observation: of the wrapped environment
        :return: an action in the wrapped environment's own bounds
        """
        scaled = self.actions.act(run, observation) if run.primitive is None else run.primitive
        low, high = self._inner_space.low, self._inner_space.high
        return (low + 0.5 * (scaled.reshape(low.shape) + 1.0) * (high - low)).astype(self._inner_space.dtype)

    def outcome(self, run: Running, observation: dict[str, np.ndarray], steps: int, stuck: bool = False) -> bool | None:
        """Tell whether an option has succeeded; None while it goes on.

        :param run: what :meth:`begin` returned
        :param observation: of the wrapped environment, after the step
        :param steps: environment steps that it has run
        :param stuck: whether the agent can do nothing any more
        """
        if not run.single:
            return self.actions.outcome(run, observation, steps, stuck)
        self.actions.primitive()
        return not stuck

    def _see(self, observation: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        self._last = observation
        return {**observation, MASK: self.masks_at(observation).astype(np.int8)}


def _actions(options: Sequence[Option] | Sequence[Walk], direct: Option | None, timeout: int) -> OptionActions | WalkActions:
    """Return what runs the options."""
    if isinstance(options, Walks) and direct is None:
        return WalkActions(options.runner)
    others = [option for option in options if isinstance(option, Option)]
    if len(others) < len(options) or isinstance(options, Walks):
        raise ValueError("Walks go with no other options, and bring the walk straight to the goal along: give agent.options.")
    return OptionActions(options, direct, timeout)  # type: ignore[arg-type]
