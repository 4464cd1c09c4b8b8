"""Which options run, and which have run in the episode: what is remembered from one step to the next."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

#: Different runs of an episode that are told apart; more are counted with others that began with the same option.
MAX_RUNS = 256
ID = "U16"  # NumPy's type of ids
#: An agent stands still if nothing that it sees changes, in so many steps in a row, by more than this share of what it changes
#: by when the agent moves: what a policy without noise does there it will do for ever. (Five agents with dead spots reached
#: .74 of their goals with 8 steps, .69 with 5, .65 without.)
STILL_STEPS, STILL = 8, 0.01
#: A pace grows by this factor in a step at most, and shrinks by that one: a single jump, into a teleporter say, is no pace.
FASTER, SLOWER = 2.0, 0.99


@dataclass(frozen=True)
class Run:
    """The end of one run of an option.

    :param env: which environment
    :param event: id of the event it began in, empty if in none
    :param option: id of the option
    :param landing: id of the event it ended in, ``goal`` for the goal, empty for none
    :param success: whether it reached its termination set
    :param steps: environment steps it took
    :param aim: where it walked to, shape ``(goal_dim,)``
    :param stuck: whether it ended since the agent can do nothing any more
    """

    env: int
    event: str
    option: str
    landing: str
    success: bool
    steps: int
    aim: np.ndarray
    stuck: bool = False


class RunnerState(NamedTuple):
    """All that must be remembered between two steps, as plain arrays with one entry for each environment.

    The one before and the one after a step may share arrays: what is to be changed in place is a copy.

    :param option: id of the running option, empty if none runs; shape ``(n_envs,)`` like all but the runs
    :param began: id of the event it began in, empty if in none
    :param aim: where it walks to, shape ``(n_envs, goal_dim)``
    :param steps: environment steps it has run, 0 if none runs
    :param timeout: environment steps it may run
    :param arrived: id of the event that the last option has led to, where the next one begins, or ``goal``; empty after a
        failure
    :param goal: what all of this is for, shape ``(n_envs, goal_dim)``
    :param elapsed: environment steps of the episode so far
    :param seen: what was seen last, observation and achieved goal, shape ``(n_envs, observation_dim + goal_dim)``
    :param pace: by how much each entry of it changes in a step when the agent moves, same shape
    :param still: steps of the running option in a row in which hardly anything has changed
    :param run_event: the episode's runs: where they began, shape ``(n_envs, MAX_RUNS)`` like all that follow
    :param run_option: which option it was, empty where there is no run
    :param run_landing: in which event it ended, or ``goal``
    :param run_success: whether it reached its termination set
    :param run_steps: the environment steps they took together
    :param run_count: how many there were of the same kind
    """

    option: np.ndarray
    began: np.ndarray
    aim: np.ndarray
    steps: np.ndarray
    timeout: np.ndarray
    arrived: np.ndarray
    goal: np.ndarray
    elapsed: np.ndarray
    seen: np.ndarray
    pace: np.ndarray
    still: np.ndarray
    run_event: np.ndarray
    run_option: np.ndarray
    run_landing: np.ndarray
    run_success: np.ndarray
    run_steps: np.ndarray
    run_count: np.ndarray

    @property
    def failed(self) -> np.ndarray:
        """For which environments the episode's last run ended, but not where it was to lead to; shape ``(n_envs,)``."""
        return (self.arrived == "") & (self.run_option[:, 0] != "")

    @classmethod
    def fresh(cls, n_envs: int, goal_dim: int, observation_dim: int) -> "RunnerState":
        """Return the state at the start of an episode."""
        ids, numbers = np.zeros(n_envs, dtype=ID), np.zeros(n_envs)
        aim, seen = np.zeros((n_envs, goal_dim), dtype=np.float32), np.zeros((n_envs, observation_dim + goal_dim))
        run_ids, run_numbers = np.zeros((n_envs, MAX_RUNS), dtype=ID), np.zeros((n_envs, MAX_RUNS))
        running = (ids, ids, aim, numbers, numbers, ids, aim, numbers, seen, seen, numbers)
        return cls(*running, run_ids, run_ids, run_ids, run_numbers.astype(bool), run_numbers, run_numbers)

    @classmethod
    def returned(cls, state: Any, n_envs: int | None = None) -> "RunnerState":
        """Return the state that an agent's ``predict`` has returned as one of these.

        :param state: what it returned
        :param n_envs: number of environments that it must be of; None for any
        :raises ValueError: if it is no such state
        """
        if not isinstance(state, tuple) or len(state) != len(cls._fields):
            raise ValueError(f"This is no state that predict has returned: {state!r:.60}.")
        known = cls(*state)
        if n_envs not in (None, len(known.option)):
            raise ValueError(f"The state is of {len(known.option)} environments, not of {n_envs}.")
        return known

    def begun_anew(self, where: np.ndarray, *, same_episode: bool = False) -> "RunnerState":
        """Return a state that is fresh for some environments.

        :param where: for which, bool array of shape ``(n_envs,)``
        :param same_episode: whether the episode goes on there, with something else to do: then how the agent moves is known
        """
        goal_dim = self.aim.shape[1]
        fresh = RunnerState.fresh(len(where), goal_dim, self.seen.shape[1] - goal_dim)
        if same_episode:
            fresh = fresh._replace(elapsed=self.elapsed, seen=self.seen, pace=self.pace)
        pairs = zip(fresh, self, strict=True)
        return RunnerState(*(np.where(where.reshape(-1, *[1] * (new.ndim - 1)), new, old) for new, old in pairs))

    def pursuing(self, goals: np.ndarray) -> "RunnerState":
        """Return the state in which goals are pursued: with another goal than so far an environment begins anew.

        What runs was begun for the old one, and the runs straight to that tell nothing of the new one.

        :param goals: shape ``(n_envs, goal_dim)``
        """
        changed = (self.elapsed > 0) & (self.goal != goals.astype(np.float32)).any(axis=1)
        return self.begun_anew(changed, same_episode=True) if changed.any() else self

    def copy(self) -> "RunnerState":
        """Return a copy that shares no memory."""
        return RunnerState(*(array.copy() for array in self))

    def having_seen(self, seen: np.ndarray) -> "RunnerState":
        """Return the state with what has changed since the last step.

        :param seen: observations and achieved goals, shape ``(n_envs, observation_dim + goal_dim)``
        """
        change = np.abs(seen - self.seen) * (self.elapsed > 0)[:, None]
        most = np.where(self.pace > 0.0, FASTER * self.pace, change)
        pace = np.maximum(SLOWER * self.pace, np.minimum(change, most))
        stands = (change <= STILL * pace).all(axis=1) & (self.elapsed > 0)
        return self._replace(seen=seen, pace=pace, still=np.where(stands, self.still + 1, 0))

    def begin(self, i: int, option: str, event: str, aim: np.ndarray, timeout: float) -> None:
        """Begin an option, in place.

        :param i: the environment
        :param option: its id
        :param event: id of the event it begins in, empty if in none
        :param aim: where it walks to, shape ``(goal_dim,)``
        :param timeout: environment steps it may run
        """
        self.option[i], self.began[i], self.aim[i], self.timeout[i] = option, event, aim, timeout
        self.steps[i] = self.still[i] = 0

    def end(self, run: Run) -> None:
        """Write a run that has ended into the record of the episode, in place."""
        i = run.env
        self.option[i], self.steps[i] = "", 0
        self.arrived[i] = run.landing if run.success else ""
        known = self.run_option[i] == run.option
        same = known & (self.run_event[i] == run.event) & (self.run_landing[i] == run.landing)
        same &= self.run_success[i] == run.success
        free = self.run_option[i] == ""
        # Where the record is full the run counts with others of its option, or else with the rarest.
        for candidates in (same, free, known):
            if candidates.any():
                slot = int(candidates.argmax())
                break
        else:
            slot = int(self.run_count[i].argmin())
        if not self.run_option[i, slot]:
            self.run_event[i, slot], self.run_option[i, slot] = run.event, run.option
            self.run_landing[i, slot], self.run_success[i, slot] = run.landing, run.success
        self.run_steps[i, slot] += run.steps
        self.run_count[i, slot] += 1
