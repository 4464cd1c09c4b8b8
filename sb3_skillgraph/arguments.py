"""An agent's arguments: what they may be, and what follows from them and from the environment."""

from inspect import signature
from typing import Any

import numpy as np
from stable_baselines3 import DDPG, SAC, TD3
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import TrainFreq
from stable_baselines3.common.vec_env import VecEnv

from sb3_skillgraph.checking import Check, anything, dict_of, number, one_of, optional, whole
from sb3_skillgraph.envs.metrics import env_metric
from sb3_skillgraph.goal_env import Oracle, env_attribute
from sb3_skillgraph.graph import SkillGraph
from sb3_skillgraph.learning.dco import LEARN_EVERY, DCOSalience
from sb3_skillgraph.learning.salience import FrontierSalience, RandomSalience, Salience
from sb3_skillgraph.memory.store import TransitionStore
from sb3_skillgraph.metric import Metric, as_metric
from sb3_skillgraph.options.learner import OptionDDPG, OptionLearner, OptionTD3
from sb3_skillgraph.rules import PaperRules

#: Steps, or episodes, after which there is training at the latest: ``learn`` does not end before.
LONGEST_ROLLOUT = 10_000
#: Learning rates beyond which any network diverges.
FASTEST = 10.0
NET_ARCH = [128, 128]  # of the walker's networks
#: Weight, in the loss of ``OptionDDPG``'s and ``OptionTD3``'s actors, of the mean squared norm of what their tanh is given:
#: keeps them from getting stuck at the bounds of the actions (success on Medium 0.96 with it, 0.61 without).
SATURATION_PENALTY = 1e-4
#: Environment steps within which a goal is to be reached, where the environment has shown no time limit.
HORIZON = 1_000
OPTION_CLASSES: dict[str, type[OffPolicyAlgorithm]] = {cls.__name__: cls for cls in (OptionDDPG, OptionTD3, DDPG, TD3, SAC)}


def option_class(given: type[OffPolicyAlgorithm] | str) -> type[OffPolicyAlgorithm]:
    """Return a class of options' policies, which may be given by name.

    :raises ValueError: if it is none
    """
    if isinstance(given, str) and given in OPTION_CLASSES:
        return OPTION_CLASSES[given]
    if isinstance(given, type) and issubclass(given, OffPolicyAlgorithm):
        return given
    raise ValueError(f"option_class is {given!r}: it must be an SB3 off-policy class, or one of {', '.join(OPTION_CLASSES)}.")


ANY = 2**62  # more than anybody asks for
#: What arguments may be that are numbers, or one of some values.
_CHECKS: dict[str, Check] = {
    "learning_rate": number(0, FASTEST, what="a schedule or a number"),
    "tau": number(0, 1),
    "gamma": number(0, 1),
    "action_noise": number(0, 1e6),
    "explore_beyond": number(0, 1e6),
    "hindsight": number(0, 1),
    "goal_tolerance": number(1e-6, 1),
    "shaping": number(0, 1e6),
    "learning_starts": whole(0, ANY),
    "buffer_size": whole(1, ANY),
    "batch_size": whole(1, ANY),
    "gradient_steps": whole(-1, 100_000),  # a call of train must end
    "stats_window_size": whole(1, ANY),
    "max_events": whole(8, ANY),
    "walk_steps": whole(1, ANY),
    "exploration_steps": whole(1, ANY),
    "seed": optional(whole(-ANY, ANY)),
    "verbose": optional(whole(-ANY, ANY)),
    "option_kwargs": optional(dict_of(anything)),
    "policy_kwargs": optional(dict_of(anything)),
    "skills": one_of("where_needed", "always", "never"),  # when walks get a network of their own
}


def check_arguments(arguments: dict[str, Any]) -> None:
    """Refuse numbers out of range, and choices that there are not.

    :param arguments: the agent's keyword arguments
    :raises ValueError: naming the argument and what it may be
    """
    given, train_freq = dict(arguments), arguments["train_freq"]
    if callable(given["learning_rate"]):
        given["learning_rate"] = 0.0
    if given["action_noise"] is None or isinstance(given["action_noise"], ActionNoise):
        given["action_noise"] = 0.0
    if given["rules"] is not None and not isinstance(given["rules"], PaperRules):
        raise ValueError(f"rules must be PaperRules() or None, not {given['rules']!r}: SkillGraphAgent(..., **PAPER).")
    for name, check in _CHECKS.items():
        check(given[name].item() if isinstance(given[name], np.generic) else given[name], name)
    if isinstance(train_freq, tuple) and len(train_freq) != 2:
        raise ValueError(f"train_freq must be a number of steps, or such as (1, 'episode'), not {train_freq!r}.")
    frequency = train_freq[0] if isinstance(train_freq, tuple) else train_freq
    if isinstance(frequency, int) and (isinstance(frequency, bool) or not 1 <= frequency <= LONGEST_ROLLOUT):
        raise ValueError(f"train_freq must be from 1 to {LONGEST_ROLLOUT}, not {train_freq!r}.")


def check_attributes(agent: OffPolicyAlgorithm) -> None:
    """Refuse what SB3 cannot use, in attributes that may have been set after construction.

    :param agent: the agent
    :raises ValueError: naming the attribute and what it may be
    """
    noise, train_freq = agent.action_noise, agent.train_freq
    if noise is not None and not isinstance(noise, ActionNoise):
        raise ValueError(
            f"agent.action_noise must be SB3's action noise or None, not {noise!r}: a number is for the constructor."
        )
    if not isinstance(train_freq, TrainFreq):
        raise ValueError(
            f"agent.train_freq must be SB3's, such as TrainFreq(4, TrainFrequencyUnit.STEP), not {train_freq!r}: a number is "
            "for the constructor."
        )


def goal_metric(given: Any, env: VecEnv | None, goal_dim: int) -> Metric:
    """Return when a goal counts as reached.

    :param given: the argument ``event_radius``; None for what the environment tells
    :param env: the environment
    :param goal_dim: length of a goal
    :raises ValueError: if nothing tells, or it is no metric of such goals
    """
    metric = None if given is None else as_metric(given)
    if metric is None and env is not None:
        metric = env_metric(lambda name: env_attribute(env, name), goal_dim)
    if metric is None:
        raise ValueError(
            "event_radius is required: the environment has neither a success_radius nor a distance_threshold to take "
            "it from. Give the distance, in goal units, within which a goal counts as reached."
        )
    metric.check(goal_dim)
    return metric


def option_kwargs(agent: OffPolicyAlgorithm, arguments: dict[str, Any]) -> dict[str, Any]:
    """Return the keyword arguments of the options' SB3 models.

    :param agent: gives SB3's arguments
    :param arguments: the agent's keyword arguments
    """
    cls = option_class(arguments["option_class"])
    kwargs: dict[str, Any] = dict(gamma=agent.gamma, policy_kwargs={"net_arch": NET_ARCH, **agent.policy_kwargs})
    if "tau" in signature(cls.__init__).parameters or issubclass(cls, OptionLearner):
        kwargs.update(tau=agent.tau)  # CrossQ has no target networks
    if issubclass(cls, OptionLearner):
        kwargs.update(actor_learning_rate=agent.learning_rate, critic_learning_rate=agent.learning_rate)
        kwargs.update(saturation_penalty=SATURATION_PENALTY)
        if "learning_rate" in (arguments["option_kwargs"] or {}):
            raise ValueError(f"option_kwargs: {cls.__name__} takes actor_learning_rate and critic_learning_rate.")
    else:
        kwargs.update(learning_rate=agent.learning_rate)
    return {**kwargs, **(arguments["option_kwargs"] or {})}


def find_salience(
    arguments: dict[str, Any], graph: SkillGraph, store: TransitionStore, agent: OffPolicyAlgorithm, relearn: int = LEARN_EVERY
) -> Salience:
    """Return what proposes salient events.

    :param arguments: the agent's keyword arguments
    :param graph: the skill graph
    :param store: the transitions
    :param agent: gives the environment
    :param relearn: transitions after which DCO learns another embedding
    :raises ValueError: if there is no such thing
    """
    salience = arguments["salience"]
    if salience == "frontier":
        return FrontierSalience(graph)
    if salience == "dco":
        return DCOSalience(store, graph.walk_steps, relearn)
    if salience == "rrt":
        return RandomSalience(Oracle(agent.get_env))
    if not hasattr(salience, "propose"):
        raise ValueError(
            f"Unknown salience {salience!r}: use 'frontier', 'rrt', 'dco' or an object with a method propose(rng) that "
            "returns a point of goal space."
        )
    return salience
