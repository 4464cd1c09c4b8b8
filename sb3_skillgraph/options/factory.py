"""Building options: a headless SB3 model each, with a view of the shared store as its replay buffer."""

import copy
from dataclasses import dataclass
from functools import partial
from inspect import signature
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_skillgraph.events import TerminationSet
from sb3_skillgraph.memory.replay import OptionReplay, OptionRule
from sb3_skillgraph.memory.store import TransitionStore
from sb3_skillgraph.options.option import Option
from sb3_skillgraph.options.parameters import parameters, set_parameters
from sb3_skillgraph.options.views import ScaledView


@dataclass(eq=False, repr=False)
class OptionFactory:
    """Makes options that share a store, a view and their hyper-parameters.

    :param option_class: SB3 off-policy class of every option's policy: ``OptionDDPG``, ``TD3``, ``SAC``, ...
    :param option_kwargs: its keyword arguments
    :param store: the shared memory of transitions
    :param view: what a policy sees
    :param action_space: action space of the environment
    :param tolerance: distance within which the global option's goals and those put in by hindsight are reached
    :param rng: random generator
    :param replay_kwargs: ``hindsight``, ``shared`` and ``horizon`` of :class:`OptionReplay`
    :param device: torch device
    :param shaping: reward for every event radius of distance gained
    """

    option_class: type[OffPolicyAlgorithm]
    option_kwargs: dict[str, Any]
    store: TransitionStore
    view: ScaledView
    action_space: spaces.Box
    tolerance: float
    rng: np.random.Generator
    replay_kwargs: dict[str, Any]
    device: th.device
    shaping: float = 0.0

    def __post_init__(self) -> None:
        self._low = self.action_space.low.ravel()
        self._half = 0.5 * (self.action_space.high.ravel() - self._low)
        dim = self.view.dim(self.store.observation_dim, self.store.goal_dim)
        self.observation_space = spaces.Box(-np.inf, np.inf, (dim,), np.float32)

    def unscale(self, scaled: np.ndarray) -> np.ndarray:
        """Turn actions in [-1, 1], shape ``(n, action_dim)``, into the environment's own bounds."""
        return self._low + self._half * (scaled + 1.0)

    def make(self, id: str, target: str | None, termination: TerminationSet | None) -> Option:
        """Make an option.

        :param id: its name
        :param target: id of what it leads to; None for the global option
        :param termination: the set it ends in; None for the global option
        :return: the option, gestating
        """
        rule = OptionRule(self.view.metric, self.tolerance, self.option_kwargs.get("gamma", 0.99), self.shaping, termination)
        replay = OptionReplay(
            self.store,
            self.view,
            rule,
            self.observation_space,
            self.action_space,
            self.rng,
            device=self.device,
            **self.replay_kwargs,
        )
        option = Option(id, target, termination, self._learner(replay), self.view.metric)
        if termination is not None:
            replay.aim = partial(getattr, option, "subgoal")  # and not a lambda: of a deep copy it is the copy's
        return option

    def _learner(self, replay: OptionReplay) -> OffPolicyAlgorithm:
        """Build the SB3 model without an environment, a logger's folder, or a reseeding of the global generators."""
        kwargs = dict(self.option_kwargs)
        if "target_entropy" in signature(self.option_class.__init__).parameters:
            kwargs.setdefault("target_entropy", -float(self.action_space.low.size))  # SAC's "auto" asks an environment
        constructor: Any = self.option_class
        learner: OffPolicyAlgorithm = constructor("MlpPolicy", None, _init_setup_model=False, device=self.device, **kwargs)
        learner.observation_space, learner.action_space, learner.n_envs = self.observation_space, self.action_space, 1
        learner.replay_buffer = replay
        with th.random.fork_rng(devices=[]):
            # Initial weights come from our own generator, so that loading an agent draws nothing from torch's.
            th.manual_seed(int(self.rng.integers(2**31)))
            try:
                learner._setup_model()
            except AttributeError as error:  # DQN and its kin ask how many actions there are
                raise ValueError(
                    f"option_class {self.option_class.__name__} cannot be built for continuous actions ({error}): use one of "
                    "OptionDDPG, OptionTD3, DDPG, TD3, SAC, or another class for Box actions."
                ) from error
        learner.set_logger(Logger(folder=None, output_formats=[]))
        learner.policy.set_training_mode(False)
        return learner


def copy_policy(source: Option, target: Option) -> None:
    """Give one option the policy and value function of another, and what their optimisers know of them.

    Optimisers that began anew would make their first steps as long as their learning rate allows, in every direction,
    and a policy that was good would be worse for a while.

    :param source: the option copied from
    :param target: the option copied to
    """
    set_parameters(target.learner, copy.deepcopy(parameters(source.learner)), True, target.learner.device)
