"""An option: initiation set, policy, termination set, effect set and the record of its runs (section 2.1)."""

from collections import deque
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy

from sb3_skillgraph.events import TerminationSet
from sb3_skillgraph.memory.replay import OptionReplay
from sb3_skillgraph.metric import Metric
from sb3_skillgraph.options.initiation import InitiationSet
from sb3_skillgraph.options.numpy_actor import NumpyActor
from sb3_skillgraph.options.parameters import parameters, set_parameters

#: States kept of those in which successful runs ended.
EFFECTS_LENGTH = 200
_COUNTS = ("mature", "n_successes", "n_runs", "n_steps")


@dataclass(eq=False, repr=False)
class Option:
    """A skill: where it may start, how it acts, where it ends.

    It names its target by id, never by object, so that it can be saved as plain data: ``target`` is a salient event,
    or, further down a skill chain, the option whose initiation set it leads to.

    An option *gestates* until it has succeeded often enough; then it is *mature*: it has an initiation set and belongs
    in the skill graph.

    :param id: its name, and that of its vertex in the skill graph
    :param target: id of the event or option it leads to; None for the global option
    :param termination: the set it ends in; None for the global option, which is given a goal each time
    :param learner: the SB3 model that holds its policy
    :param metric: of goal space
    """

    id: str
    target: str | None
    termination: TerminationSet | None
    learner: OffPolicyAlgorithm
    metric: Metric

    def __post_init__(self) -> None:
        self.initiation = InitiationSet(self.metric.radius)
        self.mature = False
        self.n_successes = 0
        self.n_runs = 0
        self.n_steps = 0  # of all runs together
        self.effects: deque[np.ndarray] = deque(maxlen=EFFECTS_LENGTH)

    def __repr__(self) -> str:
        age = "" if self.mature else ", gestating"
        return f"<option {self.id} to {self.target}{age}: {self.n_successes} of {self.n_runs} runs succeeded>"

    @property
    def replay(self) -> OptionReplay:
        """The option's view of the shared store."""
        replay = self.learner.replay_buffer
        assert isinstance(replay, OptionReplay)
        return replay

    @cached_property
    def actor(self) -> NumpyActor:
        """The policy, for roll-outs."""
        actor = self.learner.policy.actor
        assert isinstance(actor, BasePolicy)
        return NumpyActor(actor)

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Tell which points an option may aim at that leads here: this option's pessimistic initiation set.

        :param points: shape ``(n, goal_dim)``
        :return: bool array of shape ``(n,)``
        """
        return self.initiation.pessimistic(points)

    def holds(self, point: np.ndarray) -> bool:
        """Tell whether an option that leads here has succeeded at a point, shape ``(goal_dim,)``."""
        return bool(self.initiation.pessimistic(point[None])[0])

    def can_start(self, point: np.ndarray) -> bool:
        """Tell whether it may be run from a point, shape ``(goal_dim,)``.

        It must lie in its (optimistic) initiation set, and not where it ends; while an option gestates it may start anywhere:
        that is how it finds out where it should.
        """
        return (not self.mature or bool(self.initiation.optimistic(point[None])[0])) and not self.terminates(point)

    def terminates(self, point: np.ndarray) -> bool:
        """Tell whether the option has succeeded at a point, shape ``(goal_dim,)``."""
        assert self.termination is not None, "The global option ends where it is told to."
        return self.termination.holds(point)

    @property
    def subgoal(self) -> np.ndarray:
        """The point of its termination set the option aims at, shape ``(goal_dim,)``."""
        if isinstance(self.termination, Option):
            core = self.termination.initiation.core
            assert core is not None, f"Option {self.id!r} leads to {self.target!r}, which is not mature."
            return core
        center = getattr(self.termination, "center", None)
        assert center is not None, f"The target of option {self.id!r} has no centre to aim at."
        return np.asarray(center)

    @property
    def success_rate(self) -> float:
        """Share of its runs that succeeded; 0 before the first."""
        return self.n_successes / max(self.n_runs, 1)

    def succeeded(self, path: np.ndarray, end: np.ndarray, steps: int) -> None:
        """Learn from a run that reached the termination set.

        :param path: states from the start of the run to before its end, shape ``(n, goal_dim)``
        :param end: the state it ended in, shape ``(goal_dim,)``
        :param steps: environment steps it took
        """
        self.n_successes += 1
        self.n_runs += 1
        self.n_steps += steps
        self.initiation.add_success(path)
        self.effects.append(np.asarray(end, dtype=np.float64))

    def failed(self, start: np.ndarray | None, steps: int) -> None:
        """Learn from a run that failed.

        :param start: the state it began in, shape ``(goal_dim,)``; None if that was not to blame: the agent got stuck
        :param steps: environment steps it took
        """
        self.n_runs += 1
        self.n_steps += steps
        if start is not None:
            self.initiation.add_failure(start)

    def get_state(self) -> dict[str, Any]:
        """Return everything, the networks too, as plain data."""
        record = {
            **{name: getattr(self, name) for name in ("id", "target", *_COUNTS)},
            "effects": list(self.effects),
            "initiation": self.initiation.get_state(),
            "n_updates": self.learner._n_updates,
        }
        return {"record": record, "parameters": parameters(self.learner)}

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`get_state` returned."""
        record = state["record"]
        for name in _COUNTS:
            setattr(self, name, record[name])
        self.effects = deque(record["effects"], maxlen=EFFECTS_LENGTH)
        self.initiation.set_state(record["initiation"])
        self.learner._n_updates = record["n_updates"]
        set_parameters(self.learner, state["parameters"], True, self.learner.device)
