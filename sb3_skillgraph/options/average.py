"""Acting by the mean of a policy over the last of its training."""

import copy
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy

from sb3_skillgraph.options.numpy_actor import NumpyActor

#: The share of its updates that the mean is about, after so many. Who still learns fast is soon a better walker: on Medium,
#: with means from the first update on, .99 of the goals were reached after 10 000 steps instead of 1.00.
SHARE, YOUNG = 0.0125, 10_000


class AveragedPolicy:
    """
    The exponential mean of an actor's weights (Polyak and Juditsky, 1992).

    What is learned last pulls a policy to and fro; its mean walks the same ways in fewer steps.

    :param learner: the SB3 model whose actor it is the mean of
    """

    def __init__(self, learner: OffPolicyAlgorithm) -> None:
        self.learner = learner
        assert isinstance(learner.policy.actor, BasePolicy)
        self._now = learner.policy.actor
        self._mean: BasePolicy = copy.deepcopy(self._now)
        self.actor = NumpyActor(self._mean)
        # Found once: looking through the modules takes longer than the mean.
        self._parameters: tuple[list[th.Tensor], list[th.Tensor]] = [*self._now.parameters()], [*self._mean.parameters()]
        self._buffers = list(self._now.buffers()), list(self._mean.buffers())  # counts, running means

    def follow(self, n_updates: int) -> None:
        """Take in what was learned.

        :param n_updates: updates since this was last called
        """
        window = max(SHARE * (self.learner._n_updates - YOUNG), 1.0)
        weight = 1.0 - (1.0 - 1.0 / window) ** n_updates
        now, mean = self._parameters
        # SB3's polyak_update, in one call for all layers
        with th.no_grad():
            th._foreach_lerp_(mean, now, weight)
        for now_buffer, mean_buffer in zip(*self._buffers, strict=True):
            mean_buffer.copy_(now_buffer)

    def restart(self) -> None:
        """Begin with the actor as it is: its weights were set to others."""
        self._mean.load_state_dict(self._now.state_dict())

    def get_state(self) -> dict[str, np.ndarray]:
        """Return the weights."""
        return {name: tensor.detach().cpu().numpy().copy() for name, tensor in self._mean.state_dict().items()}

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`get_state` returned.

        :raises RuntimeError: if they are another network's
        """
        self._mean.load_state_dict({name: th.as_tensor(array) for name, array in state.items()})
