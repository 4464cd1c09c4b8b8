"""What options do as actions of an SMDP: when they can be taken, and how they run."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from sb3_skillgraph.choices import Choices
from sb3_skillgraph.options.option import Option
from sb3_skillgraph.planning import DIRECT
from sb3_skillgraph.runner import Chosen, Runner
from sb3_skillgraph.running import RunnerState

Observation = dict[str, np.ndarray]


class Running(NamedTuple):
    """One action while it is being executed.

    :param id: the option's id, or ``primitive 0``, ...
    :param option: whose policy acts; None for a primitive action or a walk
    :param primitive: the primitive action, scaled to [-1, 1]; None for an option
    :param aim: where the option is to go, shape ``(goal_dim,)``
    :param timeout: environment steps it may take
    :param single: whether it takes one step, whatever comes of it
    """

    id: str
    option: Option | None
    primitive: np.ndarray | None
    aim: np.ndarray
    timeout: float
    single: bool = False


def batch_of_one(observation: Observation) -> Observation:
    """Return an observation as rows: ``observation`` and ``achieved_goal``, shapes ``(1, dim)``."""
    return {key: np.asarray(observation[key], dtype=np.float32).reshape(1, -1) for key in ("observation", "achieved_goal")}


class OptionActions:
    """Options with policies and initiation sets of their own; they can be taken where they can start.

    :param options: the options, which may become more
    :param direct: the option that walks to any goal, if there is one
    :param timeout: environment steps an option may run; the walk straight to the goal, half of them
    """

    def __init__(self, options: Sequence[Option], direct: Option | None, timeout: int) -> None:
        self.options = options
        self.direct = direct
        self.timeout = timeout
        self.has_direct = direct is not None
        self.state = None

    def reset(self, observation: Observation) -> None:
        """Nothing is remembered from step to step."""

    def n(self) -> int:
        """Return the number of options."""
        return len(self.options)

    def action_of(self, id: str) -> int | None:
        """Return an option's action; None for the one that walks to any goal."""
        if self.direct is not None and id == self.direct.id:
            return None
        return {option.id: i for i, option in enumerate(self.options)}[id]

    def masks(self, observation: Observation) -> np.ndarray:
        """Tell which options are mature and stand in their (optimistic) initiation set, not yet in their termination set."""
        point = np.asarray(observation["achieved_goal"])
        return np.array([option.mature and option.can_start(point) for option in self.options], dtype=bool)

    def begin(self, observation: Observation, action: int | None) -> Running:
        """Begin to run an option."""
        option = self.direct if action is None else self.options[action]
        assert option is not None
        if action is None:
            return Running(option.id, option, None, np.asarray(observation["desired_goal"]), self.timeout // 2)
        return Running(option.id, option, None, option.subgoal, self.timeout)

    def act(self, run: Running, observation: Observation) -> np.ndarray:
        """Let its policy act."""
        assert run.option is not None
        seen = batch_of_one(observation)
        see = run.option.replay.view
        return run.option.actor.act(see(seen["observation"], seen["achieved_goal"], run.aim[None].astype(np.float32)))[0]

    def outcome(self, run: Running, observation: Observation, steps: int, stuck: bool) -> bool | None:
        """Tell whether it has come where it leads, or to the goal; None while it runs on."""
        point, option = np.asarray(observation["achieved_goal"]), run.option
        assert option is not None
        reached = option.metric.reached(point, run.aim) if option.target is None else option.terminates(point)
        if reached or stuck or steps >= int(run.timeout):
            return reached and not stuck
        return None

    def primitive(self) -> None:
        """Nothing is remembered from step to step."""


class WalkActions:
    """An agent's walks, one for every event that it has or had, run as ``predict`` runs them.

    A walk can be taken where the graph has an edge to it, and where it is a guess that plans consider.

    :param runner: runs them
    """

    has_direct = True

    def __init__(self, runner: Runner) -> None:
        self.runner = runner
        self.state: Any = RunnerState.fresh(1, runner.graph.goal_dim, 0)
        self.ids: list[str] = []
        self._action_of: dict[str, int] = {}
        self._chosen: Chosen | None = None

    def reset(self, observation: Observation) -> None:
        """Forget the last episode."""
        dim = batch_of_one(observation)["observation"].shape[1]
        self.state = RunnerState.fresh(1, self.runner.graph.goal_dim, dim)

    def n(self) -> int:
        """Return how many walks there have been; new ones come last, those whose event is gone stay."""
        ids = self.runner.graph.walk_ids
        if ids and (len(self.ids) < len(ids) or ids[-1] not in self._action_of):
            self.ids += [id for id in ids if id not in self._action_of]
            self._action_of = {id: action for action, id in enumerate(self.ids)}
        return len(self.ids)

    def action_of(self, id: str) -> int | None:
        """Return a walk's action; None for the walk straight to the goal."""
        return None if id == DIRECT else self._action_of[id]

    def choices(self, observation: Observation) -> Choices:
        """Return what the agent could begin, as plans see it."""
        point, goal = (np.asarray(observation[key], dtype=np.float32) for key in ("achieved_goal", "desired_goal"))
        return self.runner.choices(self.state, 0, point, goal)

    def masks(self, observation: Observation) -> np.ndarray:
        """Tell which walks the agent considers here."""
        mask = np.zeros(self.n(), dtype=bool)
        walk_ids = self.runner.graph.walk_ids
        mask[[self._action_of[walk_ids[i]] for i in self.choices(observation).target if i < len(walk_ids)]] = True
        return mask

    def begin(self, observation: Observation, action: int | None) -> Running:
        """Begin a walk, with the time that the agent would give it."""
        point, goal = (np.asarray(observation[key], dtype=np.float32) for key in ("achieved_goal", "desired_goal"))
        choices, graph = self.choices(observation), self.runner.graph
        target = len(graph.events) if action is None else graph.index(self.ids[action])
        row = int(np.flatnonzero(choices.target == target)[0])
        self._chosen = self.runner.option_of(choices, row, self.runner.start(self.state, 0, point), goal)
        return Running(self._chosen.option, None, None, self._chosen.aim, self._chosen.timeout)

    def act(self, run: Running, observation: Observation) -> np.ndarray:
        """Let the walker act."""
        chosen, goals = self._chosen, np.asarray(observation["desired_goal"], dtype=np.float32)[None]
        assert chosen is not None
        scaled, self.state = self.runner.act(batch_of_one(observation), goals, self.state, choose=lambda *_: chosen)
        return scaled[0]

    def outcome(self, run: Running, observation: Observation, steps: int, stuck: bool) -> bool | None:
        """Let the runner tell whether the walk has ended, and how."""
        points = np.asarray(observation["achieved_goal"], dtype=np.float32)[None]
        self.state, runs = self.runner.advance(self.state, points, [stuck])
        return runs[0].success if runs else None

    def primitive(self) -> None:
        """A step was taken: nothing runs, and the agent is where it finds itself."""
        none = np.zeros_like(self.state.arrived)
        elapsed = self.state.elapsed + (self.state.option == "")  # else the walker took it
        steps = np.zeros_like(self.state.steps)
        self.state = self.state._replace(option=none, arrived=none, steps=steps, elapsed=elapsed)
