"""The parameters of networks and optimisers as SB3 names them."""

from typing import Any

from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.save_util import recursive_getattr


def parameters(learner: OffPolicyAlgorithm) -> dict[str, Any]:
    """Return a model's state dicts by SB3's names, and under ``"variables"`` its tensors that belong to no network.

    :param learner: an SB3 model
    """
    names = learner._get_torch_save_params()[1]
    variables = {name: recursive_getattr(learner, name).data for name in names}
    return {**learner.get_parameters(), **({"variables": variables} if variables else {})}


def set_parameters(learner: OffPolicyAlgorithm, given: dict[str, Any], exact_match: bool, device: Any) -> None:
    """Set what :func:`parameters` returned.

    :param learner: an SB3 model
    :param given: the parameters
    :param exact_match: whether every parameter must be given
    :param device: torch device
    """
    given = dict(given)
    for name, tensor in given.pop("variables", {}).items():
        recursive_getattr(learner, name).data.copy_(tensor)
    learner.set_parameters(given, exact_match, device)
