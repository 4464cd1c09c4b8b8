"""Saving and loading an agent: SB3's signatures, plain data only (nothing is ever unpickled)."""

import io
import random
from collections import deque
from collections.abc import Iterable
from typing import Any, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import VectorizedActionNoise
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.utils import check_for_correct_spaces

from sb3_skillgraph.controller import Controller, ControllerState
from sb3_skillgraph.curriculum import Curriculum
from sb3_skillgraph.goal_env import refuse_vec_normalize
from sb3_skillgraph.graph import SkillGraph
from sb3_skillgraph.options.learner import OptionDDPG, OptionTD3
from sb3_skillgraph.options.option import Option
from sb3_skillgraph.parameters import Parameters
from sb3_skillgraph.pruning import Pruning
from sb3_skillgraph.replay import TransitionStore
from sb3_skillgraph.salience.discovery import EventDiscovery
from sb3_skillgraph.saving import MissingCallable, PathOrFile, known_class, load_tree, save_tree
from sb3_skillgraph.visited import VisitedStates

SelfPersistence = TypeVar("SelfPersistence", bound="Persistence")

for _option_class in (OptionDDPG, OptionTD3):
    known_class(_option_class)

_COUNTERS = ("num_timesteps", "_total_timesteps", "_num_timesteps_at_start", "_episode_num", "_n_updates")


class Persistence(Parameters):
    """How a :class:`~sb3_skillgraph.SkillGraphAgent` is saved and loaded; it is part of it, in a file of its own."""

    rng: np.random.Generator
    store: TransitionStore
    graph: SkillGraph
    visited: VisitedStates
    controller: Controller
    discovery: EventDiscovery
    pruning: Pruning
    curriculum: Curriculum
    event_radius: float
    _arguments: dict[str, Any]
    _view_name: str | None
    _state: ControllerState
    _held_actions: np.ndarray
    _hold_left: np.ndarray
    _credit: float
    _executed: list[int]
    _pending: Any
    _env_snapshot: dict[str, Any] | None = None
    _loaded = False

    # -- saving -------------------------------------------------------------------------------------------------------

    def save(
        self,
        path: PathOrFile,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        """
        Save everything but the replay buffer to one zip of JSON and ``.npy`` members.

        The environments' states are saved too, if they can tell them (``get_state``), so that learning can go on
        exactly where it was.

        :param path: path (``.zip`` is added if it has no ending) or binary file object
        :param exclude: names of constructor arguments not to save; loading then takes their defaults
        :param include: names to save even if excluded
        :raises OSError: if the file cannot be written; an old file of that name is then untouched
        """
        left_out = set(exclude or ()) - set(include or ())
        arguments = {**self._arguments, "event_radius": self.event_radius, "verbose": self.verbose}
        arguments["action_noise"] = self.action_noise
        if self._view_name is not None:
            arguments["option_view"] = self._view_name
        tree = {
            "arguments": {name: value for name, value in arguments.items() if name not in left_out},
            "spaces": {"observation": _describe(self.observation_space), "action": _describe(self.action_space)},
            "n_envs": self.n_envs,
            **self._learned_state(),
            "progress": self._progress_state(),
        }
        save_tree(path, "agent", tree)

    def _learned_state(self) -> dict[str, Any]:
        return {
            "options": [option.get_state() for option in [self.global_option, *self.options]],
            "parameters": self.get_parameters(),
            "graph": self.graph.get_state(),
            "chaining": self.chaining.get_state(),
            "discovery": self.discovery.get_state(),
            "pruning": self.pruning.get_state(),
            "visited": self.visited.get_state(),
        }

    def _progress_state(self) -> dict[str, Any]:
        """Where learning stands: counters, generators, environments and what each was in the middle of."""
        rng_state = self._pending.rng_state if self._pending is not None else self.rng.bit_generator.state
        return {
            "counters": {name: getattr(self, name) for name in _COUNTERS},
            "current_progress_remaining": self._current_progress_remaining,
            "ep_info_buffer": list(self.ep_info_buffer or ()),
            "ep_success_buffer": [bool(success) for success in self.ep_success_buffer or ()],
            "controller_state": tuple(self._state),
            "held_actions": self._held_actions,
            "hold_left": self._hold_left,
            "credit": self._credit,
            "executed": self._executed,
            "curriculum": self.curriculum.get_state(),
            "rng": rng_state,
            "global_generators": {
                "python": list(random.getstate()),
                "numpy": np.random.get_state(legacy=False),  # noqa: NPY002 - SB3's own noise draws from it
                "torch": th.get_rng_state(),
            },
            "environments": self._snapshot(),
        }

    def _snapshot(self) -> dict[str, Any] | None:
        """Return the states of the environments; None if they cannot tell them, or moved since the last stored step."""
        if self._env_snapshot is not None:
            return self._env_snapshot  # loaded, and not put to use yet
        if self.env is None or self._last_obs is None or self._pending is not None or not self.env.has_attr("get_state"):
            return None
        snapshot = {"states": self.env.env_method("get_state"), "last_obs": self._last_obs}
        if all(self.env.env_is_wrapped(Monitor)):
            snapshot["monitor_rewards"] = [list(map(float, rewards)) for rewards in self.env.get_attr("rewards")]
        return snapshot

    def save_replay_buffer(self, path: PathOrFile) -> None:
        """
        Save the filled rows of the shared store, and which of them each option ran on.

        :param path: path (``.zip`` is added if it has no ending) or binary file object
        :raises OSError: if the file cannot be written; an old file of that name is then untouched
        """
        rows = {option.id: option.replay.get_state() for option in self.options}
        save_tree(path, "replay_buffer", {"store": self.store.get_state(), "rows": rows})

    def load_replay_buffer(self, path: PathOrFile, truncate_last_traj: bool = True) -> None:
        """
        Load what :meth:`save_replay_buffer` saved.

        :param path: path or binary file object
        :param truncate_last_traj: not used: trajectories are kept apart whatever follows
        :raises ValueError: if the file is damaged or holds something else, or does not fit this agent
        """
        tree = load_tree(path, "replay_buffer")
        self.store.set_state(tree["store"])
        for option in self.options:
            if option.id in tree["rows"]:
                option.replay.set_state(tree["rows"][option.id])

    # -- loading ------------------------------------------------------------------------------------------------------

    @classmethod
    def load(
        cls: type[SelfPersistence],
        path: PathOrFile,
        env: GymEnv | None = None,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = False,
        **kwargs: Any,
    ) -> SelfPersistence:
        """
        Load an agent; nothing in the file is ever executed.

        :param path: path (with or without ``.zip``) or binary file object
        :param env: environment to go on with; None to only predict
        :param device: torch device
        :param custom_objects: arguments to use in place of the saved ones
        :param print_system_info: print the versions of this system's libraries
        :param force_reset: begin ``learn`` at a fresh episode even if the environments' states were saved (SB3's default
            is to do so; here learning goes on exactly where it was)
        :param kwargs: arguments to use in place of the saved ones
        :return: the agent
        :raises ValueError: if the file is damaged, of a newer schema or no agent at all; if the environment does not fit;
            if the agent was made with a function that must be given again
        """
        if print_system_info:
            from stable_baselines3.common.utils import get_system_info

            get_system_info()
        tree = load_tree(path, "agent")
        given = {**(custom_objects or {}), **kwargs}
        arguments = {**tree["arguments"], "device": device}
        arguments.update({name: value for name, value in given.items() if name in arguments or name in _signature(cls)})
        _require_callables(arguments)
        constructor: Any = cls  # its keyword arguments are those of the class it is part of
        agent = constructor(env=None, _init_setup_model=False, **{"policy": "MultiInputPolicy", **arguments})
        agent.observation_space = _space(tree["spaces"]["observation"])
        agent.action_space = _space(tree["spaces"]["action"])
        agent.n_envs = tree["n_envs"]
        if env is not None:
            wrapped = cls._wrap_env(env, agent.verbose)
            refuse_vec_normalize(wrapped)
            check_for_correct_spaces(wrapped, agent.observation_space, agent.action_space)
            agent.env, agent.n_envs = wrapped, wrapped.num_envs
        noise = agent.action_noise
        if isinstance(noise, VectorizedActionNoise) and noise.n_envs != agent.n_envs:
            agent.action_noise = noise.base_noise
        agent._setup_model()
        try:
            agent._restore(tree, same_envs=agent.n_envs == tree["n_envs"] and not force_reset)
        except (AttributeError, IndexError, KeyError, TypeError) as error:
            raise ValueError(
                f"The file was written by another version of sb3_skillgraph, or for another option_class ({error!r})."
            ) from error
        agent._loaded = True
        return agent

    def copy(self: SelfPersistence, env: GymEnv) -> SelfPersistence:
        """
        Copy the agent, replay buffer included; what the copy learns leaves this one as it is.

        :param env: environment of the copy
        :return: the copy
        """
        agent_file, replay_file = io.BytesIO(), io.BytesIO()
        self.save(agent_file)
        self.save_replay_buffer(replay_file)
        # What is stored by name only is given again.
        named = {name: value for name, value in self._arguments.items() if callable(value) or hasattr(value, "propose")}
        agent = type(self).load(agent_file, env=env, device=self.device, **named)
        agent.load_replay_buffer(replay_file)
        return agent

    def _restore(self, tree: dict[str, Any], same_envs: bool) -> None:
        specs = {spec["id"]: spec for spec in tree["options"]}
        self.global_option.set_state(specs.pop("global"))
        self.graph.set_state({**tree["graph"], "options": [], "nodes": [], "edges": []}, {})
        options: dict[str, Option] = {}
        for id, spec in specs.items():  # in the order of their making: a child comes after the option it leads to
            termination = self.graph.events.get(spec["target"]) or options[spec["target"]]
            options[id] = self._factory.make(id, spec["target"], termination)  # type: ignore[attr-defined]
            options[id].set_state(spec)
        self.graph.set_state(tree["graph"], options)
        self.chaining.set_state(tree["chaining"], options)
        self.discovery.set_state(tree["discovery"])
        self.pruning.set_state(tree["pruning"])
        self.visited.set_state(tree["visited"])
        self.set_parameters(tree["parameters"], exact_match=True, device=self.device)
        self._restore_progress(tree["progress"], same_envs)

    def _restore_progress(self, progress: dict[str, Any], same_envs: bool) -> None:
        for name, value in progress["counters"].items():
            setattr(self, name, value)
        self._current_progress_remaining = progress["current_progress_remaining"]
        self.ep_info_buffer = deque(progress["ep_info_buffer"], maxlen=self._stats_window_size)
        self.ep_success_buffer = deque(progress["ep_success_buffer"], maxlen=self._stats_window_size)
        self.rng.bit_generator.state = progress["rng"]
        generators = progress["global_generators"]
        random.setstate(tuple(generators["python"]))
        np.random.set_state(generators["numpy"])  # noqa: NPY002
        th.set_rng_state(generators["torch"])
        self.curriculum.set_state(progress["curriculum"])
        self._credit = progress["credit"]
        if not same_envs:
            self.curriculum.cut(self.n_envs)
            self.visited.cut(self.n_envs)
            return
        self._state = ControllerState(*progress["controller_state"])
        self._held_actions, self._hold_left = progress["held_actions"], progress["hold_left"]
        self._executed = progress["executed"]
        self._env_snapshot = progress["environments"]

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """
        Give the agent another environment with the same spaces and the same number of copies.

        :param env: the environment
        :param force_reset: whether ``learn`` begins at a fresh episode; False to go on, after ``load``, where the saved
            environments were
        :raises ValueError: if the environment does not fit, or is normalised by VecNormalize
        """
        refuse_vec_normalize(env)
        super().set_env(env, force_reset)
        if force_reset:
            self._env_snapshot, self._loaded = None, False

    def _restore_env(self) -> bool:
        """Put the environments where they were when the agent was saved, if that is known.

        :return: whether they were
        """
        snapshot, self._env_snapshot = self._env_snapshot, None
        loaded, self._loaded = self._loaded, False
        if loaded and self.verbose and snapshot is None:
            print("The environments' states are not known (no get_state/set_state): learning resumes at a fresh episode.")
        if snapshot is None or self.env is None or not self.env.has_attr("set_state"):
            return False
        self.env.reset()
        for i, state in enumerate(snapshot["states"]):
            self.env.env_method("set_state", state, indices=i)
        for i, rewards in enumerate(snapshot.get("monitor_rewards", ())):
            self.env.set_attr("rewards", rewards, indices=i)
        self._last_obs = snapshot["last_obs"]
        self._last_episode_starts = np.zeros(self.n_envs, dtype=bool)
        return True


def _signature(cls: type) -> Iterable[str]:
    return cls.__init__.__code__.co_varnames  # type: ignore[misc]


def _require_callables(arguments: dict[str, Any]) -> None:
    for name, value in arguments.items():
        if isinstance(value, MissingCallable):
            raise ValueError(
                f"The agent was made with {name}={value.name}, which is stored by name only, since loading must not run "
                f"code from a file: give it again, load(..., {name}=...)."
            )


def _describe(space: spaces.Space) -> dict[str, Any]:
    if isinstance(space, spaces.Dict):
        return {"entries": {key: _describe(entry) for key, entry in space.spaces.items()}}
    if isinstance(space, spaces.Box):
        return {"low": space.low, "high": space.high}
    raise ValueError(f"A space of this kind cannot be saved: {space}.")


def _space(description: dict[str, Any]) -> spaces.Space:
    if "entries" in description:
        return spaces.Dict({key: _space(entry) for key, entry in description["entries"].items()})
    low: np.ndarray = description["low"]
    return spaces.Box(low, description["high"], dtype=low.dtype.type)
