"""
The gradient step of SB3's DDPG and TD3 for plain networks, written out without autograd.

The numbers are SB3's, the order of random draws too. What is saved: the gradients of the critic's weights that the
actor's loss never uses, autograd's book-keeping, and Adam's and Polyak's loops over parameters in Python.

Nothing is kept beside the model: weights stay SB3's own parameters and the moments of Adam stay in
``optimizer.state``, so ``state_dict``, ``load_state_dict``, ``set_parameters`` and copies mean what they always meant.
"""

from collections.abc import Iterable
from typing import Any, NamedTuple

import torch as th
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.td3.policies import Actor, TD3Policy
from torch import nn

from sb3_skillgraph.options.plain_networks import is_plain, is_vector_space, linears

# MKL is up to four times slower at a product whose result is this narrow than at the transposed one.
NARROW = 64


class Layer:
    """
    One linear layer and its three matrix products.

    :param linear: the torch module whose parameters are used where they are
    """

    def __init__(self, linear: nn.Linear) -> None:
        self.weight = linear.weight
        self.bias = linear.bias

    def forward(self, inputs: th.Tensor, relu: bool) -> th.Tensor:
        """
        :param inputs: (batch, in)
        :param relu: whether a ReLU follows
        :return: (batch, out)
        """
        outputs = nn.functional.linear(inputs, self.weight, self.bias)
        return outputs.relu_() if relu else outputs

    def input_gradient(self, gradient: th.Tensor) -> th.Tensor:
        """
        :param gradient: (batch, out), of the loss by what this layer returned
        :return: (batch, in)
        """
        return th.mm(gradient, self.weight)

    def parameter_gradients(self, inputs: th.Tensor, gradient: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """
        :param inputs: (batch, in), what the layer was given
        :param gradient: (batch, out), of the loss by what this layer returned
        :return: (out, in) for the weight and (out,) for the bias
        """
        if inputs.shape[1] <= NARROW < gradient.shape[1]:
            # The fused optimiser walks over memory, so the layout has to be that of the weight.
            weight = th.mm(inputs.t(), gradient).t().contiguous()
        else:
            weight = th.mm(gradient.t(), inputs)
        return weight, gradient.sum(0)


class Network:
    """
    Linear layers with a ReLU between one and the next, and nothing after the last.

    :param linears: the torch modules, first to last
    """

    def __init__(self, linears: Iterable[nn.Linear]) -> None:
        self.layers = [Layer(linear) for linear in linears]

    def parameters(self) -> list[th.Tensor]:
        """:return: weight and bias of every layer, in torch's order"""
        return [parameter for layer in self.layers for parameter in (layer.weight, layer.bias)]

    def forward(self, inputs: th.Tensor) -> list[th.Tensor]:
        """
        :param inputs: (batch, in)
        :return: what every layer was given, and last what the network returns: (batch, out)
        """
        values = [inputs]
        for layer in self.layers[:-1]:
            values.append(layer.forward(values[-1], relu=True))
        values.append(self.layers[-1].forward(values[-1], relu=False))
        return values

    def parameter_gradients(self, values: list[th.Tensor], gradient: th.Tensor) -> list[th.Tensor]:
        """
        :param values: what ``forward`` returned
        :param gradient: (batch, out), of the loss by the network's result
        :return: one for each of ``parameters()``
        """
        gradients: list[th.Tensor] = []
        for i in range(len(self.layers) - 1, -1, -1):
            gradients[:0] = self.layers[i].parameter_gradients(values[i], gradient)
            if i > 0:
                gradient = self.layers[i].input_gradient(gradient)
                th.ops.aten.threshold_backward.grad_input(gradient, values[i], 0, grad_input=gradient)
        return gradients

    def slope(self, values: list[th.Tensor], scale: float, start: int) -> th.Tensor:
        """
        How ``scale`` times the sum of what a network with one output returned changes with its input.

        :param values: what ``forward`` returned
        :param scale: a factor
        :param start: the first column of the input that is asked for
        :return: (batch, in - start)
        """
        gradient = self.layers[-1].weight.mul(scale).expand(len(values[0]), -1)
        for i in range(len(self.layers) - 2, -1, -1):
            gradient = th.ops.aten.threshold_backward.default(gradient, values[i + 1], 0)
            if i > 0:
                gradient = self.layers[i].input_gradient(gradient)
            else:
                # Narrow again, and only the columns asked for.
                return th.mm(self.layers[0].weight[:, start:].t(), gradient.t()).t()
        return gradient[:, start:]


class Adam:
    """
    One fused step of a ``th.optim.Adam`` on gradients that are given, kept in that optimiser's own state.

    :param optimizer: an Adam with one group of parameters, ``amsgrad`` off
    """

    def __init__(self, optimizer: th.optim.Optimizer) -> None:
        self.optimizer = optimizer
        self._attach()

    @property
    def parameters(self) -> list[th.Tensor]:
        """:return: what the optimiser learns"""
        return self.optimizer.param_groups[0]["params"]

    def follow(self) -> None:
        """Notice when ``load_state_dict`` has put another state in place of the one in use."""
        state = self.optimizer.state
        if state is not self._state or self._counts[0] is not state.get(self.parameters[0], {}).get("step"):
            self._attach()

    def step(self, gradients: list[th.Tensor]) -> None:
        """:param gradients: one for each parameter, of its shape and contiguous"""
        group = self.optimizer.param_groups[0]
        self._all_counts.add_(1)
        th._fused_adam_(
            group["params"],
            gradients,
            self._averages,
            self._squares,
            [],
            self._counts,
            lr=group["lr"],
            beta1=group["betas"][0],
            beta2=group["betas"][1],
            weight_decay=group["weight_decay"],
            eps=group["eps"],
            amsgrad=False,
            maximize=group["maximize"],
        )

    def _attach(self) -> None:
        self._state = self.optimizer.state
        states = [self._state[parameter] for parameter in self.parameters]
        for parameter, state in zip(self.parameters, states, strict=True):
            if not state:
                state["step"] = th.zeros(())
                state["exp_avg"] = th.zeros_like(parameter)
                state["exp_avg_sq"] = th.zeros_like(parameter)
        # The counts of all parameters lie side by side, and where the parameters are, for one addition to raise them.
        self._all_counts = th.stack([state["step"].to(self.parameters[0].device) for state in states])
        self._counts = [self._all_counts[i] for i in range(len(states))]
        for state, count in zip(states, self._counts, strict=True):
            state["step"] = count
        self._averages = [state["exp_avg"] for state in states]
        self._squares = [state["exp_avg_sq"] for state in states]


class StepSettings(NamedTuple):
    """
    What a gradient step depends on beside the minibatch and the networks.

    :param gamma: discount where the minibatch has none of its own
    :param tau: SB3's soft update coefficient, 1 copies
    :param noise_std: standard deviation of the noise on the target's actions (TD3's smoothing)
    :param noise_clip: largest size of that noise
    :param saturation_penalty: weight, in the actor's loss, of the mean squared norm of what its tanh is given
    """

    gamma: float
    tau: float
    noise_std: float
    noise_clip: float
    saturation_penalty: float


class FastUpdate:
    """
    SB3's ``TD3.train`` for one policy, a gradient step at a time.

    :param policy: one for which ``why_not`` has no objection
    """

    def __init__(self, policy: TD3Policy) -> None:
        self.policy = policy
        self.actor = Network(linears(policy.actor.mu))
        self.actor_target = Network(linears(policy.actor_target.mu))
        self.critics = [Network(linears(q)) for q in policy.critic.q_networks]
        self.critic_targets = [Network(linears(q)) for q in policy.critic_target.q_networks]
        self.actor_adam = Adam(policy.actor.optimizer)
        self.critic_adam = Adam(policy.critic.optimizer)
        self._critic_targets = [parameter for critic in self.critic_targets for parameter in critic.parameters()]
        self._actor_target = self.actor_target.parameters()

    def __reduce__(self) -> tuple[type["FastUpdate"], tuple[TD3Policy]]:
        # Copies and pickles look at their own policy afresh: nothing here is more than a view of it.
        return FastUpdate, (self.policy,)

    def follow(self) -> None:
        """Use what was loaded into the optimisers since the last gradient step."""
        self.actor_adam.follow()
        self.critic_adam.follow()

    def step(self, data: ReplayBufferSamples, settings: StepSettings, with_actor: bool) -> tuple[th.Tensor, th.Tensor | None]:
        """
        One gradient step.

        :param data: a minibatch of ``batch`` transitions
        :param settings: what else it depends on
        :param with_actor: whether the actor learns too, and all targets move
        :return: the critics' loss and the actor's, each (), None without the actor
        """
        with th.inference_mode():
            critic_loss, inputs = self._update_critics(data, settings)
            if not with_actor:
                return critic_loss, None
            # Target networks move towards the learned ones as soon as those are done, while they are in the cache.
            th._foreach_lerp_(self._critic_targets, self.critic_adam.parameters, settings.tau)
            actor_loss = self._update_actor(inputs, settings.saturation_penalty)
            th._foreach_lerp_(self._actor_target, self.actor_adam.parameters, settings.tau)
            return critic_loss, actor_loss

    def _update_critics(self, data: ReplayBufferSamples, settings: StepSettings) -> tuple[th.Tensor, th.Tensor]:
        """Teach all critics the same target; return their loss and what they were given, (batch, observation + action)."""
        inputs = th.cat([_flat(data.observations), data.actions], dim=1)
        target = self._target(data, settings)
        losses: list[th.Tensor] = []
        gradients: list[th.Tensor] = []
        for critic in self.critics:
            values = critic.forward(inputs)
            losses.append(th.ops.aten.mse_loss.default(values[-1], target))
            error = th.sub(values[-1], target).mul_(2 / len(target))
            gradients += critic.parameter_gradients(values, error)
        self.critic_adam.step(gradients)
        return losses[0] if len(losses) == 1 else th.stack(losses).sum(), inputs

    def _update_actor(self, inputs: th.Tensor, saturation_penalty: float) -> th.Tensor:
        """Teach the actor to climb the first critic, overwriting the actions in ``inputs``; return the loss of that."""
        critic = self.critics[0]
        start = self.actor.layers[0].weight.shape[1]
        values = self.actor.forward(inputs[:, :start])
        penalty = values[-1] * (2 * saturation_penalty / len(inputs)) if saturation_penalty else None
        actions = values[-1].tanh_()
        inputs[:, start:] = actions
        critic_values = critic.forward(inputs)
        gradient = th.ops.aten.tanh_backward.default(critic.slope(critic_values, -1 / len(inputs), start), actions)
        if penalty is not None:
            gradient = gradient.add_(penalty)
        self.actor_adam.step(self.actor.parameter_gradients(values, gradient))
        return -critic_values[-1].mean()

    def _target(self, data: ReplayBufferSamples, settings: StepSettings) -> th.Tensor:
        observations = _flat(data.next_observations)
        # Drawn even where it is clipped to nothing (DDPG), so that the global generator ends where SB3 leaves it.
        noise = th.empty_like(data.actions).normal_(0, settings.noise_std)
        actions = self.actor_target.forward(observations)[-1].tanh_()
        if settings.noise_clip > 0:
            actions = actions.add_(noise.clamp_(-settings.noise_clip, settings.noise_clip)).clamp_(-1, 1)
        inputs = th.cat([observations, actions], dim=1)
        next_values = self.critic_targets[0].forward(inputs)[-1]
        for critic in self.critic_targets[1:]:
            next_values = th.minimum(next_values, critic.forward(inputs)[-1])
        discounted = (1 - data.dones).mul_(settings.gamma if data.discounts is None else data.discounts)
        return th.addcmul(data.rewards, discounted, next_values).float()


def why_not(policy: Any) -> str | None:
    """
    Say why ``FastUpdate`` cannot stand in for SB3's own update.

    :param policy: an SB3 policy
    :return: the reason, or None when it can
    """
    if not isinstance(policy, TD3Policy):
        return f"the policy is a {type(policy).__name__}, not a TD3Policy"
    if not is_vector_space(policy.observation_space):
        return "the observations are not plain vectors"
    models = (policy.actor, policy.actor_target, policy.critic, policy.critic_target)
    for model, known in zip(models, (Actor, Actor, ContinuousCritic, ContinuousCritic), strict=True):
        if type(model) is not known:
            return f"a network is a {type(model).__name__}, not a {known.__name__}"
        if type(model.features_extractor) is not FlattenExtractor:
            return f"the features come from a {type(model.features_extractor).__name__}"
    actors = (policy.actor.mu, policy.actor_target.mu)
    critics = (*policy.critic.q_networks, *policy.critic_target.q_networks)
    if not (all(is_plain(net, squashed=True) for net in actors) and all(is_plain(net) for net in critics)):
        return "a network is not made of Linear and ReLU layers"
    return _why_not_adam(policy.actor) or _why_not_adam(policy.critic)


def _why_not_adam(model: nn.Module) -> str | None:
    optimizer = model.optimizer
    if type(optimizer) is not th.optim.Adam:
        return f"the optimiser is {type(optimizer).__name__}, not Adam"
    own = list(model.parameters())
    groups = optimizer.param_groups
    if len(groups) != 1 or [id(p) for p in groups[0]["params"]] != [id(p) for p in own]:
        return "the optimiser does not hold the network's parameters in one group"
    for option in ("amsgrad", "capturable", "differentiable", "decoupled_weight_decay"):
        if groups[0].get(option, False):
            return f"Adam's {option} is on"
    return None


def _flat(observations: th.Tensor) -> th.Tensor:
    return observations.flatten(1).float()
