"""Which option runs, for how long, and what it does: one environment step at a time (sections 3.2.4, 3.2.5, A.6)."""

import math
from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np

from sb3_skillgraph.chaining import DeepSkillChaining
from sb3_skillgraph.events import SalientEvent
from sb3_skillgraph.graph import GraphPath
from sb3_skillgraph.options.execution import Fate, fate
from sb3_skillgraph.options.numpy_actor import NumpyActor
from sb3_skillgraph.options.option import Option
from sb3_skillgraph.options.views import View
from sb3_skillgraph.planner import GraphPlanner, Leg

STILL = 0.25  # of the event radius: less is no movement
SHAKE = 10  # steps of a random action after a run that stood still: a policy without noise would stand there for ever
MANY_DECISIONS = 12  # on the way to a goal, after which the next best way is tried
#: The last option has failed, and none runs; none runs; the global option. Others follow, in the order of their making.
FAILED, UNDECIDED, GLOBAL = -2, -1, 0


class ControllerState(NamedTuple):
    """All that must be remembered between two steps; arrays of shape ``(n_envs,)``.

    :param option: index of the running option, ``UNDECIDED``, or ``FAILED`` where it is to be chosen after a failure
    :param steps: environment steps it has run
    :param aim: where the global option walks to: ``-1`` the goal itself, ``k >= 0`` event ``k``, ``-2 - 2 * k`` visited
        point ``k`` on a way to the goal, ``-3 - 2 * k`` visited point ``k`` on a way to an event
    :param failures: approaches to the goal that have failed
    :param failed_last: index of the option that failed last on the way to the goal, ``-1`` for none
    :param failed_before: index of the one that failed before it, ``-1`` for none
    :param decisions: options chosen so far on the way to the goal; going on along a way is no decision
    :param anchor: distance from what the option aims at, when it last changed noticeably
    :param still: environment steps since then; negative: of a random action still to come

    States are never changed in place: the one before and the one after a step may share arrays.
    """

    option: np.ndarray
    steps: np.ndarray
    aim: np.ndarray
    failures: np.ndarray
    failed_last: np.ndarray
    failed_before: np.ndarray
    decisions: np.ndarray
    anchor: np.ndarray
    still: np.ndarray

    @classmethod
    def fresh(cls, n_envs: int) -> "ControllerState":
        """Return the state at the start of an episode."""
        values: dict[str, float] = {"option": UNDECIDED, "aim": -1, "failed_last": -1, "failed_before": -1, "anchor": 0.0}
        return cls(**{name: np.full(n_envs, values.get(name, 0)) for name in cls._fields})

    def begun_anew(self, where: np.ndarray) -> "ControllerState":
        """Return a state that is fresh for some environments.

        :param where: for which, bool array of shape ``(n_envs,)``
        """
        fresh = self.fresh(len(where))
        return ControllerState(*(np.where(where, new, old) for new, old in zip(fresh, self, strict=True)))

    def copy(self) -> "ControllerState":
        """Return a copy that shares no memory."""
        return ControllerState(*(array.copy() for array in self))


class Request(NamedTuple):
    """What one environment's agent is to do.

    :param goal: where to go, shape ``(goal_dim,)``
    :param event: id of the event that is the goal; None for any other goal
    :param chain: id of a skill chain to practise on the way; None at test time
    :param left_graph: the chain's source has been reached, so that the chain itself takes over
    :param direct: walk straight to the goal by the global option
    """

    goal: np.ndarray
    event: str | None = None
    chain: str | None = None
    left_graph: bool = False
    direct: bool = False


class OptionOutcome(NamedTuple):
    """The end of one run of an option: the only thing that changes statistics.

    :param env: which environment
    :param option: index of the option
    :param aim: where the global option walked to (see :class:`ControllerState`)
    :param success: whether it reached its termination set
    :param steps: environment steps it ran
    """

    env: int
    option: int
    aim: int
    success: bool
    steps: int


class Controller:
    """Runs options, choosing one whenever the last has ended; the same code while learning and in ``predict``.

    It keeps nothing between calls: what must be remembered travels in :class:`ControllerState`.

    :param global_option: the option that walks straight to any goal
    :param chaining: all other options
    :param planner: finds ways over the graph
    :param view: what a policy sees
    :param radius: the event radius, in goal units
    :param tolerance: distance within which a waypoint counts as reached, in goal units
    :param timeout: environment steps an option may run; the global option, half of them
    :param warm_start: whether gestating options act with the global option's policy
    :param stall_steps: environment steps after which an option ends that does not move; None for never

    ``planning``: whether to use the graph at all; without it the global option walks straight to every goal.
    """

    def __init__(
        self,
        global_option: Option,
        chaining: DeepSkillChaining,
        planner: GraphPlanner,
        view: View,
        radius: float,
        tolerance: float,
        timeout: int,
        warm_start: bool,
        stall_steps: int | None,
    ) -> None:
        self.global_option = global_option
        self.chaining = chaining
        self.planner = planner
        self.view = view
        self.radius = radius
        self.tolerance = tolerance
        self.timeout = timeout
        self.warm_start = warm_start
        self.stall_steps = stall_steps
        self.planning = True

    # -- options by number --------------------------------------------------------------------------------------------

    def option(self, index: int) -> Option:
        """Return an option by its index."""
        return self.global_option if index == GLOBAL else self.chaining.options[f"o{index}"]

    def index(self, option: Option) -> int:
        """Return the index of an option."""
        return GLOBAL if option is self.global_option else int(option.id[1:])

    def event(self, index: int) -> SalientEvent:
        """Return an event by its index."""
        return self.planner.graph.events[f"e{index}"]

    # -- one step -----------------------------------------------------------------------------------------------------

    def advance(
        self, state: ControllerState, points: np.ndarray, requests: Sequence[Request], stuck: np.ndarray | None = None
    ) -> tuple[ControllerState, list[OptionOutcome]]:
        """End the options that have reached their termination set or timed out, or whose agent is stuck.

        :param state: the state after the step
        :param points: where the agents stand, shape ``(n_envs, goal_dim)``
        :param requests: what each is to do
        :param stuck: which agents can do nothing any more, shape ``(n_envs,)``; None for none
        :return: the state, undecided where an option ended; one outcome per option that ended
        """
        lost = [False] * len(requests) if stuck is None else stuck.tolist()
        ended: list[tuple[int, bool]] = []
        for i, index in enumerate(state.option.tolist()):
            if index < GLOBAL:
                continue
            what = self._fate(index, state, i, points[i], requests[i], lost[i])
            if what != Fate.RUNNING:
                ended.append((i, what == Fate.SUCCEEDED))
        if not ended:
            return state, []
        state = state.copy()
        return state, [self._end(state, i, success) for i, success in ended]

    def _fate(self, index: int, state: ControllerState, i: int, point: np.ndarray, request: Request, stuck: bool) -> Fate:
        if index != GLOBAL and f"o{index}" not in self.chaining.options:
            return Fate.TIMED_OUT  # pruned meanwhile
        timeout = 0 if self._stalled(state, i) else self.timeout if index != GLOBAL else self.timeout // 2
        return fate(self._reached(index, int(state.aim[i]), request, point), int(state.steps[i]), timeout, stuck)

    def _stalled(self, state: ControllerState, i: int) -> bool:
        return self.stall_steps is not None and int(state.still[i]) >= self.stall_steps

    def _reached(self, index: int, aim: int, request: Request, point: np.ndarray) -> bool:
        if index != GLOBAL:
            return self.option(index).terminates(point)
        if aim >= 0:
            return self.event(aim).holds(point)
        radius = self.radius if aim == -1 else self.tolerance
        return math.dist(point.tolist(), self._aim(index, aim, request).tolist()) <= radius

    def _end(self, state: ControllerState, i: int, success: bool) -> OptionOutcome:
        index, aim = int(state.option[i]), int(state.aim[i])
        state.option[i] = UNDECIDED if success else FAILED
        if not success:
            state.aim[i] = -1  # so that no way is retraced further
        if not success and index == GLOBAL:
            state.failures[i] += 1
        elif not success and index != state.failed_last[i]:
            state.failed_before[i], state.failed_last[i] = state.failed_last[i], index
        return OptionOutcome(i, index, aim, success, int(state.steps[i]))

    def act(
        self,
        observation: dict[str, np.ndarray],
        state: ControllerState,
        requests: Sequence[Request],
    ) -> tuple[np.ndarray, np.ndarray, ControllerState]:
        """Choose an option where none is running, and let the options act.

        :param observation: ``observation`` and ``achieved_goal``, shapes ``(n_envs, dim)``
        :param state: the state before the step
        :param requests: what each agent is to do
        :return: actions scaled to [-1, 1], shape ``(n_envs, action_dim)``; the points the options aim at, shape
            ``(n_envs, goal_dim)``; the state after the step
        """
        points = observation["achieved_goal"]
        undecided = [i for i, index in enumerate(state.option.tolist()) if index < GLOBAL]
        if undecided:
            state = state.copy()
        for i in undecided:
            failed = {int(state.failed_last[i]), int(state.failed_before[i])}
            # Where it has not just failed it takes the best way. Going round in circles is failing, too.
            failures = int(state.failures[i]) if state.option[i] == FAILED else 0
            failures += int(state.decisions[i]) // MANY_DECISIONS
            before = int(state.aim[i])
            state.option[i], state.aim[i] = self.choose(points[i], requests[i], failures, failed, before)
            state.decisions[i] += not (_leads_to_goal(before) and _leads_to_goal(int(state.aim[i])))
            state.still[i] = -SHAKE if self._stalled(state, i) else 0
            state.steps[i], state.anchor[i] = 0, np.inf
        options = state.option.tolist()
        aims = np.array(
            [self._aim(*what) for what in zip(options, state.aim.tolist(), requests, strict=True)], dtype=np.float32
        )
        seen = self.view(observation["observation"], points, aims)
        if len(options) == 1:
            actions = self._actor(options[0]).act(seen)
        else:
            actions = np.concatenate([self._actor(index).act(seen[i : i + 1]) for i, index in enumerate(options)])
        for i in np.flatnonzero(state.still < 0).tolist():
            rng = np.random.default_rng([int(state.failures[i]), int(state.decisions[i])])  # acting depends on the state alone
            actions[i] = rng.uniform(-1.0, 1.0, actions.shape[1])
        still, anchor = self._watch(state, points, aims)
        return actions, aims, state._replace(steps=state.steps + 1, still=still, anchor=anchor)

    def _watch(self, state: ControllerState, points: np.ndarray, aims: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Count the steps for which an agent has stood still, by its distance from where it is going, or is shaken loose."""
        still, anchor = state.still.tolist(), state.anchor.tolist()
        for i, (point, aim) in enumerate(zip(points.tolist(), aims.tolist(), strict=True)):
            distance = math.dist(point, aim)
            if still[i] < 0 or abs(distance - anchor[i]) < STILL * self.radius:
                still[i] += 1
            else:
                still[i], anchor[i] = 0, distance
        return np.array(still), np.array(anchor)

    def _actor(self, index: int) -> NumpyActor:
        option = self.option(index)
        gestates_with_global = self.warm_start and not option.mature
        return (self.global_option if gestates_with_global else option).actor

    def _aim(self, index: int, aim: int, request: Request) -> np.ndarray:
        if index != GLOBAL:
            return self.option(index).subgoal
        if aim >= 0:
            return self.event(aim).center
        return request.goal if aim == -1 else self.planner.visited.point((-2 - aim) // 2)

    # -- choosing an option -------------------------------------------------------------------------------------------

    def choose(
        self, point: np.ndarray, request: Request, failures: int, failed: Collection[int], last_aim: int = -1
    ) -> tuple[int, int]:
        """Choose the option to run next.

        :param point: where the agent stands, shape ``(goal_dim,)``
        :param request: what it is to do
        :param failures: approaches to the goal that have failed
        :param failed: indices of options that have failed lately
        :param last_aim: where the last run of the global option has led (see :class:`ControllerState`)
        :return: index of the option; where the global option is to walk to (see :class:`ControllerState`)
        """
        if request.direct or not self.planning:
            return GLOBAL, -1
        avoid = [f"o{index}" for index in failed if index > GLOBAL]
        if request.chain is not None:
            return self._practise(point, request, failures, avoid)
        if request.event is not None:
            return self._towards(point, request.event, failures, avoid)
        if _leads_to_goal(last_aim):  # do not turn back half-way
            onward = self._retrace(point, request.goal, -1, failures)
            if _leads_to_goal(onward[1]):
                return onward
        return self._to_goal(point, request.goal, failures, avoid)

    def _practise(self, point: np.ndarray, request: Request, failures: int, avoid: Collection[str]) -> tuple[int, int]:
        """Plan to the chain's source; from there on, the chain's earliest admissible option (section 3.2.5)."""
        assert request.chain is not None
        chain = self.chaining.chains[request.chain]
        source = self.planner.graph.events[chain.source]
        if request.left_graph or source.holds(point):
            return self.index(self.chaining.admissible(chain, point)), -1
        return self._towards(point, source.id, failures, avoid)

    def _towards(self, point: np.ndarray, event: str, failures: int, avoid: Collection[str]) -> tuple[int, int]:
        """Follow the plan to an event; outside the graph, walk to where it can be entered."""
        path = self.planner.path_to(point, event, avoid)
        if path is not None:
            return self.index(self._first(path)), -1
        entry = self.planner.entry(point, event) or self.planner.graph.events[event]
        return self._walk_to(point, entry, failures)

    def _to_goal(self, point: np.ndarray, goal: np.ndarray, failures: int, avoid: Collection[str]) -> tuple[int, int]:
        """Follow the cheapest way to a goal; after a failed approach the next one.

        After all of them the global option retraces whatever way comes nearest, then goes straight, then all begins anew.
        """
        legs = self.planner.legs(point, goal, avoid)
        ways: list[Leg | SalientEvent] = list(legs)
        if not legs and (nearest := self.planner.vertices_near(goal)):
            entry = self.planner.entry(point, nearest[0][0].id)
            ways += [] if entry is None else [entry]
        turn = failures % (len(ways) + 2)
        if turn > len(ways):
            return GLOBAL, -1
        way = ways[turn] if turn < len(ways) else None
        if isinstance(way, SalientEvent):
            return self._walk_to(point, way, failures)
        if way is None or way.path is None:
            return self._retrace(point, goal, -1, failures)
        return self.index(self._first(way.path)), -1

    def _first(self, path: GraphPath) -> Option:
        return self.chaining.options[path.vertices[0]]

    def _walk_to(self, point: np.ndarray, event: SalientEvent, failures: int) -> tuple[int, int]:
        return self._retrace(point, event.center, int(event.id[1:]), failures)

    def _retrace(self, point: np.ndarray, goal: np.ndarray, aim: int, failures: int) -> tuple[int, int]:
        """Walk to a goal by the global option, along a way that has been gone before if there is one."""
        waypoint = self.planner.waypoint(point, goal, failures)
        return GLOBAL, aim if waypoint < 0 else -2 - 2 * waypoint - (aim >= 0)


def _leads_to_goal(aim: int) -> bool:
    """Tell whether an aim of the global option is a waypoint on the way to the goal."""
    return aim < -1 and aim % 2 == 0
