"""A goal environment lifted into an SMDP: one action is one run of an option (section 2.1)."""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_skillgraph.options.execution import Fate, fate
from sb3_skillgraph.options.option import Option
from sb3_skillgraph.options.walk import Walk

MASK = "action_mask"
MOST_AXES = 2  # up to so many dimensions of actions, primitive actions push along each axis
Route = Callable[[np.ndarray, np.ndarray], np.ndarray]


class Run(NamedTuple):
    """One action while it is being executed.

    :param id: the option's id, or ``primitive 0``, ...
    :param option: whose policy acts; None for a primitive action
    :param primitive: the primitive action, scaled to [-1, 1]; None for an option
    :param aim: where the option is to go, shape ``(goal_dim,)``
    :param reached: whether it has got there, given where the agent stands
    :param timeout: environment steps it may take
    """

    id: str
    option: Option | None
    primitive: np.ndarray | None
    aim: np.ndarray
    reached: Callable[[np.ndarray], bool]
    timeout: int


class OptionsEnv(gym.Wrapper):
    """
    An environment whose actions are options.

    Action ``i`` runs ``options[i]`` until it reaches its termination set, times out or the episode ends. The last actions
    can always be taken: the global option, if there is one, which walks to the goal, then primitive actions, which take one
    step. The reward is the discounted sum of the rewards on the way, and ``info`` has ``tau`` (environment steps taken),
    ``discount`` (``gamma ** tau``), ``option`` (id) and ``option_success``.

    Observations gain an entry ``action_mask``, which :meth:`action_masks` returns as well: an option may run if it is
    mature, stands in its (optimistic) initiation set and not yet in its termination set. Options may be appended to the
    list at any time; actions of those still unborn are masked.

    Where the agent gets stuck (``info["stuck"]``) the episode is over, and costs are added up as if it stood there for
    ever. A ``Monitor`` belongs around this environment, not into it: from inside it does not see such an end.

    :param env: a goal environment (Dict observations, Box actions)
    :param options: options; the global option may be among them
    :param global_option: walks straight to any goal; by default the one among ``options``
    :param primitives: actions scaled to [-1, 1], shape ``(n, action_dim)``; None takes both directions of every axis and
        standing still where actions have at most two dimensions, else one step of the global option's policy
    :param max_options: number of actions: room for options and primitive actions
    :param gamma: discount factor per environment step
    :param timeout: environment steps an option may run; the global option, half of them
    :param route: tells, given where the agent stands and its goal, where the global option is to go first; by default
        straight to the goal
    :raises ValueError: if the environment is no goal environment, nothing can always be done, or there is too little room
    """

    def __init__(
        self,
        env: gym.Env,
        options: Sequence[Option],
        *,
        global_option: Option | None = None,
        primitives: np.ndarray | None = None,
        max_options: int = 64,
        gamma: float = 0.99,
        timeout: int = 200,
        route: Route | None = None,
    ) -> None:
        super().__init__(env)
        inner = env.observation_space
        if not isinstance(inner, spaces.Dict) or "desired_goal" not in inner.spaces:
            raise ValueError(f"OptionsEnv needs a goal environment with Dict observations, not {inner}.")
        if not isinstance(env.action_space, spaces.Box):
            raise ValueError(f"OptionsEnv needs an environment with Box actions, not {env.action_space}.")
        if any(isinstance(option, Walk) for option in options):
            raise ValueError(
                "OptionsEnv takes options with policies and initiation sets of their own, such as those of CoveringOptions; "
                "walks, of which an agent's graph is made, cannot be its actions yet."
            )
        self.options = options
        self.gamma = gamma
        self.timeout = timeout
        self.route = route
        listed = next((option for option in options if option.target is None), None)
        self.global_option: Option | None = global_option or listed
        self._is_listed = listed is not None
        self.primitives = self._find_primitives(env.action_space, primitives)
        self.max_options = max_options
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
            primitives = [None] if self.global_option is not None else []  # one step of the global policy
        if not primitives and self.global_option is None:
            raise ValueError(
                "There are neither primitive actions nor a global option, so that there could be places where nothing can "
                "be done: give a global_option."
            )
        return primitives

    def _check_room(self) -> None:
        if len(self.options) > self.first_fixed:
            needed = self.max_options - self.first_fixed + len(self.options)
            raise ValueError(
                f"{len(self.options)} options and {needed - len(self.options)} actions that can always be taken do not fit "
                f"into max_options={self.max_options}: give max_options={2 ** math.ceil(math.log2(needed))}."
            )

    @property
    def first_fixed(self) -> int:
        """The first of the actions that can always be taken: the global option if there is one, then primitives."""
        return self.max_options - len(self.primitives) - (self.global_option is not None and not self._is_listed)

    @property
    def global_action(self) -> int:
        """Index of the global option.

        :raises ValueError: if there is none
        """
        if self.global_option is None:
            raise ValueError("There is no global option: OptionsEnv(..., global_option=...).")
        return self.index(self.global_option.id) if self._is_listed else self.first_fixed

    def index(self, option: str) -> int:
        """Return an option's action.

        :param option: its id
        :raises KeyError: if there is none of that name
        """
        for i, candidate in enumerate(self.options):
            if candidate.id == option:
                return i
        raise KeyError(option)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Begin an episode.

        :param seed: seeds the wrapped environment
        :param options: passed to the wrapped environment
        :return: observation and info
        """
        observation, info = self.env.reset(seed=seed, options=options)
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
        self._check_room()
        point = np.asarray(observation["achieved_goal"])
        mask = np.zeros(self.max_options, dtype=bool)
        mask[: len(self.options)] = [
            option.target is None
            or (option.mature and bool(option.initiation.optimistic(point[None])[0]) and not option.terminates(point))
            for option in self.options
        ]
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
            what = fate(run.reached(np.asarray(observation["achieved_goal"])), tau, run.timeout, bool(info.get("stuck")))
            if what == Fate.STUCK:
                terminated = True
                total += discount * min(float(reward), 0.0) / max(1.0 - self.gamma, 1e-3)
            if what != Fate.RUNNING or terminated or truncated:
                break
        info = {**info, "tau": tau, "discount": discount, "option": run.id, "option_success": what == Fate.SUCCEEDED}
        return self._see(observation), total, terminated, truncated, info

    def begin(self, observation: dict[str, np.ndarray], action: int) -> Run:
        """Begin to execute an action.

        :param observation: of the wrapped environment
        :param action: its index
        """
        point, goal = np.asarray(observation["achieved_goal"]), np.asarray(observation["desired_goal"])
        option = self.options[action] if action < self.first_fixed else self.global_option
        if option is not None and option.target is not None:
            return Run(option.id, option, None, option.subgoal, option.terminates, self.timeout)
        index = action - self.max_options + len(self.primitives)
        if index >= 0:
            primitive = self.primitives[index]
            acts = self.global_option if primitive is None else None
            return Run(f"primitive {index}", acts, primitive, goal, lambda point: True, 1)
        assert option is not None
        aim, radius = goal, option.radius
        if self.route is not None:
            aim = self.route(point, goal)
            radius = radius if aim is goal else 0.5 * radius
        return Run(option.id, option, None, aim, lambda point: math.dist(point, aim) <= radius, self.timeout // 2)

    def act(self, run: Run, observation: dict[str, np.ndarray]) -> np.ndarray:
        """Return what a running option does.

        :param run: what :meth:`begin` returned
        :param observation: of the wrapped environment
        :return: an action in the wrapped environment's own bounds
        """
        scaled = run.primitive
        if run.option is not None:
            seen, point = (
                np.asarray(observation[key], dtype=np.float32).reshape(1, -1) for key in ("observation", "achieved_goal")
            )
            see = run.option.replay.view
            scaled = run.option.actor.act(see(seen, point, run.aim[None].astype(np.float32)))[0]
        assert scaled is not None
        low, high = self._inner_space.low, self._inner_space.high
        return (low + 0.5 * (scaled.reshape(low.shape) + 1.0) * (high - low)).astype(self._inner_space.dtype)

    def _see(self, observation: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        self._last = observation
        return {**observation, MASK: self.masks_at(observation).astype(np.int8)}
