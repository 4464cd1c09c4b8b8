"""The parameters of an agent's options under SB3's names, in SB3's methods."""

from collections.abc import Iterable
from typing import Any

import torch as th
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.save_util import recursive_getattr

from sb3_skillgraph.chaining import DeepSkillChaining
from sb3_skillgraph.options.option import Option
from sb3_skillgraph.saving import load_tree


class OptionList(list[Option]):
    """Options in the order of their making; one can also be found by its id, as an item or as an attribute.

    :param options: all but the global one
    :param global_option: the one that walks straight to any goal; it is not in the list
    """

    def __init__(self, options: Iterable[Option], global_option: Option) -> None:
        super().__init__(options)
        self.global_option = global_option

    def __getitem__(self, key: Any) -> Any:
        return self._by_id(key) if isinstance(key, str) else super().__getitem__(key)

    def __getattr__(self, name: str) -> Option:
        try:
            return self._by_id(name)
        except KeyError as error:
            raise AttributeError(str(error)) from error

    def _by_id(self, id: str) -> Option:
        for option in self:
            if option.id == id:
                return option
        raise KeyError(f"There is no option {id!r} among {len(self)}.")


class Parameters(OffPolicyAlgorithm):
    """How the parameters of a :class:`~sb3_skillgraph.SkillGraphAgent` are got and set; part of it, in a file of its own."""

    global_option: Option
    chaining: DeepSkillChaining

    @property
    def options(self) -> OptionList:
        """All options but the global one, in the order of their making."""
        return OptionList(self.chaining.options.values(), self.global_option)

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        names, variables = [], []
        for prefix in ["global_option", *(f"options.{option.id}" for option in self.options)]:
            option_names, option_variables = recursive_getattr(self, prefix).learner._get_torch_save_params()
            names += [f"{prefix}.learner.{name}" for name in option_names]
            variables += [f"{prefix}.learner.{name}" for name in option_variables]
        return names, variables

    def get_parameters(self) -> dict[str, Any]:
        """
        Return the parameters of all networks and optimisers.

        :return: state dicts by name: ``"policy"`` (the global option's), ``"options.o1.learner.policy"``, ...; tensors
            that belong to no network (SAC's entropy coefficient) under ``"variables"``
        """
        names, variables = self._get_torch_save_params()
        parameters = {_public(name): recursive_getattr(self, name).state_dict() for name in names}
        if variables:
            parameters["variables"] = {name: recursive_getattr(self, name).data for name in variables}
        return parameters

    def set_parameters(
        self,
        load_path_or_dict: str | dict[str, Any],
        exact_match: bool = True,
        device: th.device | str = "auto",
    ) -> None:
        """
        Set the parameters of networks and optimisers.

        :param load_path_or_dict: what :meth:`get_parameters` returned, or the path of a saved agent
        :param exact_match: whether every parameter must be given
        :param device: torch device on which a file is loaded
        :raises ValueError: if a name is unknown, or missing although ``exact_match``; if a file cannot be read
        :raises RuntimeError: if the tensors do not fit
        """
        given = (
            load_path_or_dict if isinstance(load_path_or_dict, dict) else load_tree(load_path_or_dict, "agent")["parameters"]
        )
        names, variables = self._get_torch_save_params()
        expected = {_public(name): name for name in names}
        unknown = set(given) - set(expected) - {"variables"}
        if unknown:
            raise ValueError(f"Key {sorted(unknown)[0]} is an invalid object name: this agent has {', '.join(expected)}.")
        missing = set(expected) - set(given)
        if exact_match and missing:
            raise ValueError(f"Names of parameters do not match agents' parameters: {sorted(missing)} are missing.")
        for key, state in given.items():
            if key == "variables":
                for name in variables:
                    recursive_getattr(self, name).data.copy_(state[name])
                continue
            target = recursive_getattr(self, expected[key])
            if isinstance(target, th.optim.Optimizer):
                target.load_state_dict(state)
            else:
                target.load_state_dict(state, strict=exact_match)


def _public(name: str) -> str:
    """SB3's name for the global option's parameters is that of the agent's own policy."""
    return name.removeprefix("global_option.learner.")
