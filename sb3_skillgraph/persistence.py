"""An agent to and from plain data: nothing is ever unpickled."""

import io
import warnings
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import asdict
from inspect import signature
from typing import Any, NamedTuple

import numpy as np
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import ActionNoise, VectorizedActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.utils import check_for_correct_spaces, get_device
from stable_baselines3.common.vec_env import VecEnv

from sb3_skillgraph import generators
from sb3_skillgraph.goal_env import describe_space, make_space, refuse_changed_goals
from sb3_skillgraph.metric import Metric, as_saved
from sb3_skillgraph.options.learner import OptionDDPG, OptionTD3
from sb3_skillgraph.options.parameters import set_parameters
from sb3_skillgraph.rules import PaperRules
from sb3_skillgraph.saving import MissingCallable, PathOrFile, check_encoding, known_classes, load_tree
from sb3_skillgraph.schema import COUNTERS, check_header, check_learned, check_parameters, finite

known_classes(OptionDDPG, OptionTD3)

#: What building and filling an agent raises if it is given something else than was saved.
UNFIT = (AssertionError, AttributeError, IndexError, KeyError, MemoryError, OverflowError, RuntimeError, TypeError)


class Loaded(NamedTuple):
    """What a loaded agent needs to go on exactly, and has not put to use yet.

    :param update_path: by which update it was trained
    :param generators: states of the process's generators
    """

    update_path: str
    generators: dict[str, Any]


def agent_tree(agent: Any, left_out: Iterable[str]) -> dict[str, Any]:
    """Return everything but the replay buffer.

    :param agent: a :class:`~sb3_skillgraph.SkillGraphAgent`
    :param left_out: names of constructor arguments to leave out
    """
    parts = agent.parts
    return {
        "arguments": {name: value for name, value in _arguments(agent).items() if name not in left_out},
        "spaces": {"observation": describe_space(agent.observation_space), "action": describe_space(agent.action_space)},
        "n_envs": agent.n_envs,
        "walker": parts.walker.learner._n_updates,
        "update_path": getattr(parts.walker.learner, "update_path", "reference"),
        "horizon": parts.planner.horizon,
        "parameters": agent.get_parameters(),
        **parts.get_state(),
        "progress": _progress(agent),
    }


def _arguments(agent: Any) -> dict[str, Any]:
    """Return the constructor's arguments; those of SB3 that are read from attributes while learning as they are now."""
    arguments = dict(agent._arguments)
    for name in ("batch_size", "gamma", "gradient_steps", "learning_rate", "learning_starts", "tau", "verbose"):
        arguments[name] = getattr(agent, name)
    arguments["train_freq"] = (agent.train_freq.frequency, agent.train_freq.unit.value)
    arguments["event_radius"] = as_saved(agent.metric)
    if agent.rules is not None:
        arguments["rules"] = asdict(agent.rules)
    if agent.action_noise is not None or isinstance(arguments["action_noise"], ActionNoise):
        arguments["action_noise"] = agent.action_noise
    if agent.parts.view_name is not None:
        arguments["option_view"] = agent.parts.view_name
    return arguments


def _progress(agent: Any) -> dict[str, Any]:
    """Where learning stands: counters, generators, environments and what each was in the middle of."""
    rollout, salience = agent.parts.rollout, agent.parts.missions.salience
    pending = rollout.pending
    return {
        "counters": {name: getattr(agent, name) for name in COUNTERS},
        "current_progress_remaining": agent._current_progress_remaining,
        "ep_info_buffer": [episode for info in agent.ep_info_buffer or () for episode in _measured(info)],
        "ep_success_buffer": [bool(success) for success in agent.ep_success_buffer or ()],
        "rollout": rollout.get_state(),
        "salience": _told("The salience", salience.get_state) if hasattr(salience, "get_state") else None,
        "rng": agent.parts.rng.bit_generator.state if pending is None else pending.rng_state,
        "global_generators": generators.get_states() if agent._loaded is None else agent._loaded.generators,
        "environments": _snapshot(agent),
    }


def _measured(info: dict[str, Any]) -> list[dict[str, float]]:
    """Return what SB3 logs of an episode; nothing if its reward is no number, which means nothing here anyway."""
    measured = {name: float(info[name]) for name in ("r", "l", "t")}
    return [measured] if np.isfinite(list(measured.values())).all() else []


def _told(who: str, get_state: Callable[[], Any]) -> Any:
    """Return a state that only an exact continuation needs; None, with a warning, if it cannot be had or saved."""
    try:
        state = get_state()
        check_encoding(state, "its state")
        finite(state, "its state")
        return state
    except Exception as error:  # whatever the user's own code, or a worker that has died, raises
        warnings.warn(
            f"{who} cannot tell its state ({type(error).__name__}: {error}): all else is saved, but learning will not go on "
            "exactly where it was.",
            stacklevel=2,
        )
        return None


def _snapshot(agent: Any) -> dict[str, Any] | None:
    """Return the states of the environments; None if they moved since the last stored step, or cannot tell them."""
    if agent._env_snapshot is not None:
        return agent._env_snapshot  # loaded, and not put to use yet
    if agent.env is None or agent._last_obs is None or agent.parts.rollout.pending is not None:
        return None
    return _told("The environment", lambda: _env_states(agent.env, agent._last_obs))


def _env_states(env: VecEnv, last_obs: Any) -> dict[str, Any] | None:
    if not env.has_attr("get_state"):
        return None
    snapshot = {"states": env.env_method("get_state"), "last_obs": last_obs}
    if all(env.env_is_wrapped(Monitor)):
        rewards = [list(map(float, own)) for own in env.get_attr("rewards")]
        if all(np.isfinite(own).all() for own in rewards):
            snapshot["monitor_rewards"] = rewards
    return snapshot


def load(cls: Any, path: PathOrFile, env: Any, device: Any, given: dict[str, Any], force_reset: bool) -> Any:
    """Make the agent that a file holds.

    :param cls: :class:`~sb3_skillgraph.SkillGraphAgent`
    :param path: path (with or without ``.zip``) or binary file object
    :param env: environment to go on with; None to only predict
    :param device: torch device
    :param given: arguments to use in place of the saved ones
    :param force_reset: whether ``learn`` is to begin at a fresh episode
    :raises ValueError: if the file is damaged, or does not fit
    :raises TypeError: if there is no such argument
    :raises RuntimeError: if there is no such device
    """
    get_device(device)  # one that there is not is no fault of the file
    tree = load_tree(path, "agent")
    check_header(tree, cls)
    unknown = set(given) - set(signature(cls.__init__).parameters)
    if unknown:
        raise TypeError(f"{cls.__name__} has no argument {sorted(unknown)[0]!r}.")
    try:
        return _build(cls, tree, env, device, given, force_reset)
    except UNFIT as error:
        raise ValueError(
            f"The file was written by another version of sb3_skillgraph, or for another option_class ({error!r})."
        ) from error


def _build(cls: Any, tree: dict[str, Any], env: Any, device: Any, given: dict[str, Any], force_reset: bool) -> Any:
    # Nothing in a file decides where anything is written.
    arguments = {"policy": "MultiInputPolicy", **tree["arguments"], "device": device, "tensorboard_log": None}
    if arguments.get("rules") is not None:
        arguments["rules"] = PaperRules(**arguments["rules"])
    arguments.update(given)
    require_callables(arguments)
    agent = cls(env=None, _init_setup_model=False, **arguments)
    agent.observation_space = make_space(tree["spaces"]["observation"])
    agent.action_space = make_space(tree["spaces"]["action"])
    agent.n_envs = tree["n_envs"]
    if env is not None:
        wrapped = cls._wrap_env(env, agent.verbose)
        refuse_changed_goals(wrapped)
        check_for_correct_spaces(wrapped, agent.observation_space, agent.action_space)
        agent.env, agent.n_envs = wrapped, wrapped.num_envs
    noise = agent.action_noise
    if isinstance(noise, VectorizedActionNoise) and noise.n_envs != agent.n_envs:
        agent.action_noise = noise.base_noise
    agent._setup_model()
    check_learned(agent, tree, None if force_reset else agent.env)
    _restore(agent, tree, same_envs=agent.n_envs == tree["n_envs"] and not force_reset)
    agent._loaded = Loaded(tree["update_path"], tree["progress"]["global_generators"])
    return agent


def copy(agent: Any, env: Any) -> Any:
    """Return an agent that knows the same, replay buffer included.

    :param agent: a :class:`~sb3_skillgraph.SkillGraphAgent`
    :param env: environment of the copy
    """
    agent_file, replay_file = io.BytesIO(), io.BytesIO()
    agent.save(agent_file)
    agent.save_replay_buffer(replay_file)
    given = {**kept_by_name(agent._arguments), "event_radius": agent.metric}
    before = generators.get_states()
    try:
        twin = load(type(agent), agent_file, env, agent.device, given, force_reset=False)
    finally:
        generators.set_states(before)  # which loading has seeded
    twin.load_replay_buffer(replay_file)
    return twin


def _restore(agent: Any, tree: dict[str, Any], same_envs: bool) -> None:
    """Give a new agent what another one has learned."""
    parts = agent.parts
    parts.walker.learner._n_updates = tree["walker"]
    agent.set_parameters(tree["parameters"], exact_match=True, device=agent.device)
    parts.set_state(tree)
    if not parts.rollout.is_told_limit:
        parts.planner.horizon = tree["horizon"]
    progress = tree["progress"]
    for name in COUNTERS:
        setattr(agent, name, progress["counters"][name])
    agent._current_progress_remaining = progress["current_progress_remaining"]
    agent.ep_info_buffer = deque(progress["ep_info_buffer"], maxlen=agent._stats_window_size)
    agent.ep_success_buffer = deque(progress["ep_success_buffer"], maxlen=agent._stats_window_size)
    if progress["salience"] is not None:
        parts.missions.salience.set_state(progress["salience"])
    parts.rng.bit_generator.state = progress["rng"]
    parts.rollout.set_state(progress["rollout"], same_envs)
    if same_envs:
        agent._env_snapshot = progress["environments"]
    before = generators.get_states()
    try:
        generators.set_states(progress["global_generators"])  # or they are none
    finally:
        generators.set_states(before)


def restore_env(agent: Any) -> bool:
    """Put the environments where they were when the agent was saved, if that is known.

    :param agent: a :class:`~sb3_skillgraph.SkillGraphAgent`
    :return: whether they were
    """
    snapshot, agent._env_snapshot = agent._env_snapshot, None
    loaded, agent._loaded = agent._loaded, None
    if loaded is not None:
        path = getattr(agent.parts.walker.learner, "update_path", "reference")
        if path != loaded.update_path:
            warnings.warn(
                f"The walker was trained by the {loaded.update_path} update and goes on with the {path} update: their numbers "
                "differ in the last digits, so that learning does not go on exactly as it would have.",
                stacklevel=5,
            )
        if agent.verbose and snapshot is None:
            print("The environments' states are not known (no get_state/set_state): learning resumes at a fresh episode.")
        generators.set_states(loaded.generators)
    if snapshot is None or agent.env is None or not agent.env.has_attr("set_state"):
        return False
    agent.env.reset()
    for i, state in enumerate(snapshot["states"]):
        agent.env.env_method("set_state", state, indices=i)
    for i, rewards in enumerate(snapshot.get("monitor_rewards", ())):
        agent.env.set_attr("rewards", rewards, indices=i)
    agent._last_obs = snapshot["last_obs"]
    agent._last_episode_starts = np.zeros(agent.n_envs, dtype=bool)
    return True


def load_parameters(learner: OffPolicyAlgorithm, tree: dict[str, Any], exact_match: bool, device: Any) -> None:
    """Set the parameters that a saved agent has; all of them, or none: they are checked before anything is set.

    :param learner: an SB3 model
    :param tree: what :func:`agent_tree` returned
    :param exact_match: whether every parameter must be given
    :param device: torch device
    :raises ValueError: if they do not fit
    """
    try:
        check_parameters(learner, tree["parameters"])
        set_parameters(learner, tree["parameters"], exact_match, device)
    except UNFIT as error:
        raise ValueError(f"The parameters in the file do not fit this agent ({error!r}).") from error


def restore_experience(parts: Any, state: dict[str, Any]) -> None:
    """Give an agent's store the rows of a file; all of them, or none: they are checked before anything is written.

    :param parts: the agent's parts
    :param state: what their ``get_experience`` returned
    :raises ValueError: if they do not fit
    """
    try:
        parts.set_experience(state)
    except UNFIT as error:
        raise ValueError(f"The rows in the file do not fit this agent ({error!r}).") from error


def kept_by_name(arguments: dict[str, Any]) -> dict[str, Any]:
    """Return the arguments that are stored by name only, to be given again.

    :param arguments: of the constructor
    """
    return {name: value for name, value in arguments.items() if _is_kept_by_name(value)}


def _is_kept_by_name(value: Any) -> bool:
    if isinstance(value, dict):
        return any(_is_kept_by_name(each) for each in value.values())
    return callable(value) or hasattr(value, "propose") or isinstance(value, Metric)


def require_callables(arguments: Any, name: str = "") -> None:
    """Ask for what is stored by name only.

    :param arguments: of the constructor, as they were loaded
    :param name: of the argument that they belong to
    :raises ValueError: naming the argument
    """
    if isinstance(arguments, MissingCallable):
        raise ValueError(
            f"The agent was made with {name}={arguments.name}, which is stored by name only, since loading must not run "
            f"code from a file: give it again, load(..., {name}=...)."
        )
    if isinstance(arguments, dict):
        for key, value in arguments.items():
            require_callables(value, name or str(key))
    elif isinstance(arguments, list | tuple):
        for value in arguments:
            require_callables(value, name)
    elif isinstance(arguments, ActionNoise):
        require_callables(vars(arguments), name)
