"""
SB3's actors and critics, handed to the compiled update.

Nothing is kept beside a model: parameters are torch's own memory and Adam's moments stay in ``optimizer.state``, so
``state_dict``, ``load_state_dict``, ``set_parameters`` and copies mean what they always meant.
"""

import itertools
import math
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np
import torch as th
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.td3.policies import Actor, TD3Policy
from stable_baselines3.td3.td3 import TD3
from torch import nn

from sb3_skillgraph.memory.replay import Minibatch
from sb3_skillgraph.options.numpy_actor import is_plain, plain_linears

if TYPE_CHECKING:
    from sb3_skillgraph.options import kernel

#: Options of Adam that the kernel has not.
ADAM_OPTIONS = ("weight_decay", "amsgrad", "maximize", "capturable", "differentiable")


class CompiledUpdate:
    """
    The compiled update of one policy.

    :param policy: one for which ``why_not`` has no objection
    """

    def __init__(self, policy: TD3Policy) -> None:
        from sb3_skillgraph.options import kernel  # when it is used: it needs numba

        self._kernel = kernel
        self._policy = policy
        self._n_observations = math.prod(policy.observation_space.shape or ())
        self._n_actions = math.prod(policy.action_space.shape or ())
        self._optimizers = _optimizers(policy)
        _create_moments(self._optimizers)
        sizes = self._n_observations, self._n_actions
        self._actor = _places("the actor", policy.actor.mu, policy.actor_target.mu, self._optimizers[0], sizes)
        sizes = self._n_observations + self._n_actions, 1
        pairs = enumerate(zip(policy.critic.q_networks, policy.critic_target.q_networks, strict=True))
        self._critics = np.stack([_places(f"critic {i}", *pair, self._optimizers[1], sizes) for i, pair in pairs])
        self._parameters = list(policy.parameters())
        self._layout = self._find_layout()
        self._noise = th.empty(0, self._n_actions)

    def is_of(self, policy: TD3Policy) -> bool:
        """
        Tell whether this is the update of a policy as it is now.

        :param policy: the policy
        :return: False if it was built for another one, if a tensor lies elsewhere by now (optimisers get other ones from a
            state dict), is laid out otherwise or learns no more, or if an option of Adam has changed
        """
        same_objects = policy is self._policy and _optimizers(policy) == self._optimizers
        return same_objects and self._find_layout() == self._layout

    def _find_layout(self) -> list[Any]:
        # Asked before all updates of a step, so in as few words as it takes
        states = [state for optimizer in self._optimizers for state in optimizer.state.values()]
        tensors = [*self._parameters, *(moment for state in states for moment in state.values())]
        options = [optimizer.param_groups[0].get(name) for optimizer in self._optimizers for name in ADAM_OPTIONS]
        learning = [parameter.requires_grad for parameter in self._parameters]
        return [options, learning, [tensor.data_ptr() for tensor in tensors], [tensor.is_contiguous() for tensor in tensors]]

    def update(self, data: Minibatch, model: TD3, penalty: float, with_actor: bool) -> tuple[float, float]:
        """
        Do one update.

        :param data: a minibatch
        :param model: its discount, tau and noise are used
        :param penalty: weight, in the actor's loss, of the mean squared norm of what its tanh is given
        :param with_actor: whether the actor learns too, and all targets move
        :return: the critics' loss and the actor's (NaN without the actor)
        """
        n = len(data.actions)
        if len(self._noise) != n:
            self._noise = th.empty(n, self._n_actions, dtype=th.float32)
        # Drawn even where it is clipped to nothing (DDPG), so that torch's generator ends where SB3 leaves it.
        self._noise.normal_(0, model.target_policy_noise)
        discounts = np.float32(model.gamma) if data.discounts is None else _rows(data.discounts, n, 1)
        batch = (
            _rows(data.observations, n, self._n_observations),
            _rows(data.actions, n, self._n_actions),
            _rows(data.next_observations, n, self._n_observations),
            self._noise.numpy(),
            _rows(data.rewards, n, 1),
            (np.float32(1) - _rows(data.dones, n, 1)) * discounts,
        )
        tau = model.tau if with_actor else 0.0
        actor_rates, critic_rates = (_rates(optimizer, tau) for optimizer in self._optimizers)
        learners = self._actor, self._critics, actor_rates, critic_rates
        return self._kernel.update(batch, *learners, float(model.target_noise_clip), float(penalty), with_actor)


def why_not(policy: Any) -> str | None:
    """
    Say why there is no compiled update of a policy.

    :param policy: an SB3 policy
    :return: the reason, or None when there is one
    """
    if not isinstance(policy, TD3Policy):
        return f"the policy is a {type(policy).__name__}, not a TD3Policy"
    if policy.device.type != "cpu":
        return f"the networks are on the device {policy.device}"
    critic = policy.critic
    if type(critic) is not ContinuousCritic or type(critic.features_extractor) is not FlattenExtractor:
        return "the critics are not SB3's on plain vectors"
    if not plain_linears(policy.actor) or not all(is_plain(network) for network in critic.q_networks):
        return "a network is not made of Linear and ReLU layers on plain vectors"
    if not all(parameter.requires_grad for parameter in (*policy.actor.parameters(), *critic.parameters())):
        return "a parameter does not learn"
    if not (_is_plain_adam(policy.actor) and _is_plain_adam(critic)):
        return f"an optimiser is not Adam without {', '.join(ADAM_OPTIONS)}"
    return None


def _is_plain_adam(model: Actor | ContinuousCritic) -> bool:
    groups = model.optimizer.param_groups
    return (
        type(model.optimizer) is th.optim.Adam
        and [id(parameter) for parameter in groups[0]["params"]] == [id(parameter) for parameter in model.parameters()]
        and not any(groups[0].get(option) for option in ADAM_OPTIONS)
    )


def _optimizers(policy: TD3Policy) -> tuple[th.optim.Optimizer, th.optim.Optimizer]:
    return policy.actor.optimizer, policy.critic.optimizer


def _create_moments(optimizers: Iterable[th.optim.Optimizer]) -> None:
    """Give parameters that have not learned what Adam gives them at its first step."""
    for optimizer in optimizers:
        for parameter in optimizer.param_groups[0]["params"]:
            state = optimizer.state[parameter]
            if not state:
                state["step"] = th.tensor(0.0, dtype=th.float32)
                state["exp_avg"] = th.zeros_like(parameter, memory_format=th.preserve_format)
                state["exp_avg_sq"] = th.zeros_like(parameter, memory_format=th.preserve_format)


def _rates(optimizer: th.optim.Optimizer, tau: float) -> "kernel.Rates":
    group = optimizer.param_groups[0]
    beta1, beta2 = group["betas"]
    return float(group["lr"]), float(beta1), float(beta2), float(group["eps"]), float(tau)


def _places(
    name: str, network: nn.Module, target: nn.Module, optimizer: th.optim.Optimizer, sizes: tuple[int, int]
) -> "kernel.Learner":
    """Return where a network, its target and its moments are, if all of it is as the numbers in and out ask."""
    shapes = _shapes(network, *sizes)
    states = [optimizer.state[parameter] for parameter in network.parameters()]
    kinds = ("exp_avg", "exp_avg_sq", "step")
    if any(not isinstance(state.get(kind), th.Tensor) for state in states for kind in kinds):
        raise ValueError(f"The optimiser of {name} has a parameter without one of {', '.join(kinds)}.")
    tensors = {"value": list(network.parameters()), "target": list(target.parameters())}
    tensors |= {kind: [state[kind] for state in states] for kind in kinds}
    places = [
        [
            _place(f"{kind} of parameter {i} of {name}", tensor, () if kind == "step" else shape)
            for i, (tensor, shape) in enumerate(zip(tensors[kind], shapes, strict=True))
        ]
        for kind in tensors
    ]
    return np.array(places, dtype=np.int64)


def _shapes(network: nn.Module, n_inputs: int, n_outputs: int) -> list[tuple[int, ...]]:
    """Return what the shapes of weights and biases must be."""
    hidden = [module.out_features for module in network.children() if isinstance(module, nn.Linear)][:-1]
    shapes: list[tuple[int, ...]] = []
    for fan_in, fan_out in itertools.pairwise((n_inputs, *hidden, n_outputs)):
        shapes += [(fan_out, fan_in), (fan_out,)]
    return shapes


def _place(name: str, tensor: th.Tensor, shape: tuple[int, ...]) -> tuple[int, int, int]:
    """Return where a tensor is, in two dimensions; compiled code looks at no shape before it writes."""
    if tensor.shape != shape:
        raise ValueError(f"The {name} has the shape {tuple(tensor.shape)}, not {shape}.")
    if tensor.dtype != th.float32 or tensor.device.type != "cpu" or not tensor.is_contiguous():
        raise ValueError(f"The {name} is not contiguous float32 in the CPU's memory.")
    rows, columns = (1, 1, *shape)[-2:]
    return tensor.data_ptr(), rows, columns


def _rows(array: np.ndarray, n_rows: int, width: int) -> np.ndarray:
    """Return a part of a minibatch, of which there must be as much as the networks and the other parts expect."""
    return np.ascontiguousarray(array, np.float32).reshape(n_rows, width)
