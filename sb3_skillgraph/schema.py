"""What an agent's file may hold: checked before anything is built of it, and before anything built is filled."""

import copy
import itertools
from inspect import signature
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.save_util import recursive_getattr
from stable_baselines3.common.vec_env import VecEnv

from sb3_skillgraph.checking import (
    HUGE,
    MOST,
    Check,
    anything,
    array,
    dict_of,
    each,
    entries,
    flag,
    list_of,
    number,
    one_of,
    optimizer_state,
    optional,
    refuse,
    sized,
    state_dict,
    text,
    whole,
)
from sb3_skillgraph.edges import MAX_LANDINGS, NOWHERE, NUMBERS
from sb3_skillgraph.learning.growth import ENOUGH_RUNS, GESTATION
from sb3_skillgraph.learning.witness import N_SAMPLES
from sb3_skillgraph.running import RunnerState
from sb3_skillgraph.walk_model import N_FEATURES

#: Environments that an agent may have had.
MOST_ENVS = 10_000
#: Environment steps of the longest episode that is planned for.
MOST_STEPS = 10_000_000
#: SB3's counters, which are saved.
COUNTERS = ("num_timesteps", "_total_timesteps", "_num_timesteps_at_start", "_episode_num", "_n_updates")


def check_header(tree: dict[str, Any], cls: Any) -> None:
    """Check what an agent is built of.

    :param tree: what the file holds
    :param cls: the agent's class
    :raises ValueError: naming what is wrong
    """
    space = entries(low=anything, high=anything)
    entries(
        True,
        arguments=dict_of(anything),
        spaces=entries(observation=entries(entries=dict_of(space)), action=space),
        n_envs=whole(1, MOST_ENVS),
        walker=whole(),
        update_path=one_of("kernel", "reference"),
        parameters=entries(True, policy=dict_of(anything)),
        progress=anything,
    )(tree, "the file")
    unknown = set(tree["arguments"]) - set(signature(cls.__init__).parameters)
    if unknown:
        refuse("arguments", f"those of {cls.__name__}", sorted(unknown))
    # No network is built that is larger than the one that is stored.
    stored = sum(int(np.prod(np.shape(value))) for value in tree["parameters"]["policy"].values())
    promised = _size(tree["arguments"].get("policy_kwargs") or {})
    if promised > stored:
        raise ValueError(f"arguments/policy_kwargs promise {promised} numbers, but the file holds {stored} of networks.")


def _size(tree: Any) -> int:
    """Return how many numbers the networks have, at the least, that some keyword arguments of a policy ask for."""
    if isinstance(tree, int | float) and not isinstance(tree, bool):
        return int(tree) if abs(tree) < np.inf else MOST
    if isinstance(tree, dict):
        return max((_size(value) for value in tree.values()), default=0)
    if isinstance(tree, list | tuple):
        sizes = [_size(value) for value in tree]
        return max([*sizes, sum(a * b for a, b in itertools.pairwise(sizes))], default=0)
    return 0


def check_learned(agent: Any, tree: dict[str, Any], env: VecEnv | None) -> None:
    """Check what an agent has learned, against an agent of the same arguments.

    :param agent: the agent that is loaded, or saved
    :param tree: what the file holds
    :param env: is asked whether it takes the states of environments; None not to ask
    :raises ValueError: naming what is wrong
    """
    check_parameters(agent.parts.walker.learner, tree["parameters"])
    _check_noise(agent)
    finite({name: value for name, value in tree.items() if name not in ("arguments", "spaces", "parameters")}, "the file")
    if agent.rules is not None:
        return
    n_events = len(tree["graph"]["events"]) if isinstance(tree.get("graph"), dict) else 0
    spec, metric = agent._spec, agent.metric
    entries(
        True,
        horizon=whole(1, MOST_STEPS),
        average=state_dict(agent.parts.average.get_state()),
        graph=_graph(n_events, spec.goal_dim),
        model=_model(metric.n_matched),
        skills=list_of(entries(record=anything, parameters=anything)),
        progress=_progress(tree["n_envs"], spec, n_events, metric.n_matched, agent, env),
    )(tree, "the file")
    _check_edges(tree["graph"], n_events)


def check_parameters(learner: OffPolicyAlgorithm, given: Any) -> None:
    """Check the networks and optimisers of a model.

    :param learner: an SB3 model of the same kind
    :param given: what ``get_parameters`` returned
    :raises ValueError: naming what is wrong
    """
    own = learner.get_parameters()
    entries(True, **dict.fromkeys(own, anything))(given, "parameters")
    for name, value in own.items():
        holder = recursive_getattr(learner, name)  # as SB3 finds them: "actor.optimizer"
        check = optimizer_state(holder) if isinstance(holder, th.optim.Optimizer) else state_dict(value)
        check(given[name], f"parameters/{name}")
    finite(given.get("variables", {}), "parameters/variables")


def _check_noise(agent: Any) -> None:
    if agent.action_noise is None:
        return
    before = np.random.get_state()  # noqa: NPY002 - SB3's own noise draws from it
    drawn = np.asarray(copy.deepcopy(agent.action_noise)(), dtype=np.float64)
    np.random.set_state(before)  # noqa: NPY002
    n_actions = agent._spec.action_dim
    if drawn.shape not in ((n_actions,), (agent.n_envs, n_actions)) or not np.isfinite(drawn).all():
        refuse("arguments/action_noise", f"noise for {n_actions} actions", drawn)


def finite(tree: Any, where: str) -> None:
    """Check that no number of a tree is infinite or none.

    :param tree: plain data
    :param where: it stands
    :raises ValueError: naming the place
    """
    if isinstance(tree, float) and not np.isfinite(tree):
        refuse(where, "finite", tree)
    if isinstance(tree, np.ndarray) and tree.dtype.kind == "f" and not np.isfinite(tree).all():
        refuse(where, "finite", tree)
    if isinstance(tree, dict):
        for name, value in tree.items():
            finite(value, f"{where}/{name}")
    if isinstance(tree, list | tuple):
        for i, value in enumerate(tree):
            finite(value, f"{where}/{i}")


# -- the graph --------------------------------------------------------------------------------------------------------


def _graph(n_events: int, goal_dim: int) -> Check:
    event = entries(id=text, center=array((goal_dim,)), salient=flag)
    index, weights = array((None,), "i", 0, n_events - 1), array((None,), low=0.0)
    return entries(
        events=list_of(event),
        walks=list_of(text, n_events),
        edges=entries(
            source=index,
            target=index,
            landing=array((None, MAX_LANDINGS), "i", NOWHERE, n_events - 1),
            landing_weight=array((None, MAX_LANDINGS), low=0.0),
            **dict.fromkeys(NUMBERS, weights),
            let_go=array((None, 2), "i", 0, n_events - 1),
        ),
        visits=array((n_events,), low=0.0),
        barren=array((n_events,), low=0.0),
        cover_radius=number(1e-30, HUGE),
        now=number(0.0, MOST),
        n_made=whole(n_events),
    )


def _check_edges(graph: dict[str, Any], n_events: int) -> None:
    """Check that ids are different, and edges, and that all columns are as long."""
    ids = [event["id"] for event in graph["events"]]
    if len({*ids, *graph["walks"]}) < 2 * n_events or any(not id for id in (*ids, *graph["walks"])):
        refuse("graph", "one of events and walks with different ids", ids)
    edges = graph["edges"]
    lengths = {len(column) for name, column in edges.items() if name != "let_go"}
    pairs = {*zip(edges["source"].tolist(), edges["target"].tolist(), strict=False)}
    if len(lengths) > 1 or len(pairs) < max(lengths) or any(source == target for source, target in pairs):
        refuse("graph/edges", "columns of one length, a row for each pair of events", sorted(lengths))


def _model(n_matched: int) -> Check:
    numbers = array((N_FEATURES + n_matched,), low=-1e9, high=1e9)
    return entries(
        n_matched=one_of(n_matched),
        mean=numbers,
        scale=array((N_FEATURES + n_matched,), low=1e-9, high=1e9),
        coefficients=numbers,
        intercept=number(-1e9, 1e9),
        pace=array((3,), low=-1e9, high=1e9),
        steps_per_radius=number(0.0, 1e9),
        fastest=number(0.0, 1e9),
        loss=array((2,), low=0.0, high=1.0),
        patience=number(0.0, 1.0),
        n_runs=number(0.0, MOST),
        version=whole(),
    )


# -- where learning stands --------------------------------------------------------------------------------------------


def _progress(n_envs: int, spec: Any, n_events: int, n_matched: int, agent: Any, env: VecEnv | None) -> Check:
    episode = entries(r=number(), l=number(), t=number())
    return entries(
        counters=entries(**dict.fromkeys(COUNTERS, whole())),
        current_progress_remaining=number(-1e9, 1.0),
        ep_info_buffer=list_of(episode),
        ep_success_buffer=list_of(flag),
        rollout=_rollout(n_envs, spec, n_events, n_matched),
        salience=anything,
        rng=_pcg64,
        global_generators=entries(python=list_of(anything, 3), numpy=_mt19937, torch=anything),
        environments=optional(_environments(n_envs, agent, env)),
    )


def _rollout(n_envs: int, spec: Any, n_events: int, n_matched: int) -> Check:
    fresh = RunnerState.fresh(n_envs, spec.goal_dim, spec.observation_dim)
    goal = array((spec.goal_dim,))
    mission = entries(
        goal=goal,
        explore_steps=whole(-MOST_STEPS),
        beyond=optional(goal),
        begins_in=text,
        exploring=flag,
        n_failures=whole(),
        clean=flag,
    )
    event, passed = whole(0, max(n_events - 1, 0)), each(whole(), number(0.0), kind=tuple)
    stay = each(event, whole(), whole(), number(0.0), sized(list_of(passed), 1))
    return entries(
        runner=each(*(_like(name, column) for name, column in zip(fresh._fields, fresh, strict=True)), kind=tuple),
        held=array((n_envs, spec.action_dim), low=-1.0, high=1.0),
        hold_left=array((n_envs,), "i", 0, MOST),
        n_stuck=whole(),
        ran=dict_of(whole()),
        n_steps=whole(),
        longest=whole(),
        missions=entries(current=list_of(optional(mission), n_envs)),
        witness=entries(
            samples=sized(array((None, 4 + n_matched), low=0.0), 0, N_SAMPLES),
            n_samples=whole(),
            n_steps=whole(),
            stays=list_of(list_of(stay), n_envs),
            step=list_of(whole(), n_envs),
            began=array((n_envs, spec.goal_dim)),
            growth=entries(
                runs=dict_of(sized(list_of(flag), 0, GESTATION)),
                suspects=list_of(text),
                before=dict_of(whole(0, ENOUGH_RUNS)),
                again=dict_of(number(0.0)),
            ),
        ),
    )


def _pcg64(value: Any, where: str) -> None:
    """Check the state of a generator; one with an even increment may draw the same for ever."""
    state = entries(state=whole(0, 2**128 - 1), inc=whole(1, 2**128 - 1))
    entries(bit_generator=one_of("PCG64"), state=state, has_uint32=whole(0, 1), uinteger=whole(0, 2**32 - 1))(value, where)
    if value["state"]["inc"] % 2 == 0:
        refuse(f"{where}/state/inc", "odd", value["state"]["inc"])


def _mt19937(value: Any, where: str) -> None:
    """Check the state of NumPy's global generator, which is not all zeros."""
    state = entries(key=array((624,), "u"), pos=whole(0, 624))
    entries(bit_generator=one_of("MT19937"), state=state, has_gauss=whole(0, 1), gauss=number())(value, where)
    if not value["state"]["key"][1:].any():
        refuse(f"{where}/state/key", "a state", value["state"]["key"])


def _like(name: str, column: np.ndarray) -> Check:
    """Check an array of a runner's state, which has the shape and kind of another one; what counts is not negative."""
    return array(column.shape, column.dtype.kind, -HUGE if name in ("aim", "goal", "seen") else 0.0)


def _state_of(env: VecEnv) -> Any:
    """Return the state of the first environment; None if it cannot tell it, as before its first reset."""
    try:
        return env.env_method("get_state", indices=0)[0] if env.has_attr("get_state") else None
    except Exception:  # whatever the user's own code raises
        return None


def _environments(n_envs: int, agent: Any, env: VecEnv | None) -> Check:
    """Check the states of environments: of the one that is given, if it can tell its own."""
    spaces = agent.observation_space.spaces.items()
    shown = {name: array((n_envs, *box.shape), box.dtype.kind) for name, box in spaces}
    own = _state_of(env) if env is not None and env.num_envs == n_envs else None
    if env is not None and own is not None:
        shapes = entries(**{name: _like_any(value) for name, value in own.items()}) if isinstance(own, dict) else anything

        def state(value: Any, where: str) -> None:
            shapes(value, where)
            try:
                env.env_method("set_state", value, indices=0)
            except Exception as error:
                raise ValueError(f"{where} is refused by the environment: {error}") from error
            finally:
                env.env_method("set_state", own, indices=0)

    else:
        state = anything
    rewards = list_of(list_of(number()), n_envs)
    checks: dict[str, Check] = {"states": list_of(state, n_envs), "last_obs": entries(**shown)}

    def check(value: Any, where: str) -> None:
        with_rewards = isinstance(value, dict) and "monitor_rewards" in value
        entries(**checks, **({"monitor_rewards": rewards} if with_rewards else {}))(value, where)

    return check


def _like_any(own: Any) -> Check:
    # How long it is may change from step to step, as of what remembers the way.
    return array((None,) * own.ndim, own.dtype.kind) if isinstance(own, np.ndarray) else anything
