"""One step of learning: act, with noise, towards what the missions want; learn from where that led (Figure 10)."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from stable_baselines3.common.noise import ActionNoise

from sb3_skillgraph.choices import OPTIMISTIC
from sb3_skillgraph.learning.missions import Agenda, Mission
from sb3_skillgraph.learning.scale import LOOK_AT, tell_scale
from sb3_skillgraph.learning.witness import Witness
from sb3_skillgraph.memory.store import TransitionStore
from sb3_skillgraph.planning import DIRECT, GOAL
from sb3_skillgraph.runner import Runner
from sb3_skillgraph.running import RunnerState

#: A random action is held for so many environment steps in the mean: single ones average out.
HOLD = 10
#: Share of the steps on the way that are random. With none, or twice as many, Medium was at .92, .97 after 10 000 steps
#: instead of 1.00 (three seeds, not told apart).
RANDOM_ACTION_PROB = 0.1


class Step(NamedTuple):
    """A step between its taking and its storing."""

    observation: dict[str, np.ndarray]
    action: np.ndarray
    state: RunnerState
    held: np.ndarray
    hold_left: np.ndarray
    rng_state: Any


@dataclass(eq=False, repr=False)
class Rollout:
    """What the agent is in the middle of in each environment, while it learns.

    :param runner: runs options
    :param missions: what the agent is about
    :param witness: learns from trajectories and runs
    :param store: receives every transition, once
    :param noise_std: standard deviation of the Gaussian noise on scaled actions, where no other noise is given
    :param rng: random generator
    :param random_action_prob: share of the steps, beside explorations, that are random
    """

    runner: Runner
    missions: Agenda
    witness: Witness
    store: TransitionStore
    noise_std: float
    rng: np.random.Generator
    random_action_prob: float = RANDOM_ACTION_PROB

    def __post_init__(self) -> None:
        self.pending: Step | None = None
        self.n_stuck = 0  # episodes given up
        self.is_told_limit = False  # whether the environment says how long episodes are
        self.ran: dict[str, int] = {}  # environment steps of each skill since there was training
        self.n_steps = 0  # and of all together
        self._forget()

    def begin_anew(self, points: np.ndarray) -> None:
        """Begin an episode in every environment.

        :param points: where, shape ``(n_envs, goal_dim)``
        """
        self._forget()
        for env, point in enumerate(points):
            self.witness.begin(env, point)

    def _forget(self) -> None:
        """Forget what the environments were in the middle of."""
        n_envs, graph = self.store.n_envs, self.runner.graph
        self.state = RunnerState.fresh(n_envs, graph.goal_dim, self.store.observation_dim)
        self.held = np.zeros((n_envs, self.store.action_dim), dtype=np.float32)
        self.hold_left = np.zeros(n_envs, dtype=np.int64)
        self.longest = 0  # steps of the longest episode that was cut since
        self.pending = None
        self.store.cut()
        self.witness.cut(n_envs)
        self.missions.cut(n_envs)

    # -- acting -------------------------------------------------------------------------------------------------------

    def act(self, observation: dict[str, np.ndarray], warm_up: bool, noise: ActionNoise | None) -> np.ndarray:
        """Choose what to do; nothing is kept until the step is stored.

        :param observation: ``observation`` and ``achieved_goal``, shapes ``(n_envs, dim)``
        :param warm_up: whether all actions are to be random
        :param noise: to add; None for Gaussian noise
        :return: scaled actions, shape ``(n_envs, action_dim)``
        """
        # Should the step never be stored, it is taken back
        rng_state = self.rng.bit_generator.state
        points = observation["achieved_goal"]
        missions = [self.missions.of(i, point, warm_up) for i, point in enumerate(points)]
        # Who explores goes straight for a point that no option leads to; the others follow plans to their missions' goals,
        # which count on more than is sure, so that what is unknown gets tried
        state = self._explorers(self.state, missions)
        goals = np.stack([mission.goal for mission in missions])
        scaled, state = self.runner.act(observation, goals, state, OPTIMISTIC)
        scaled, held, hold_left = self.with_noise(scaled, missions, noise)
        self.pending = Step(observation, scaled, state, held, hold_left, rng_state)
        return scaled

    def _explorers(self, state: RunnerState, missions: list[Mission]) -> RunnerState:
        """Send those who explore on towards their point; the option of a random walk runs, but does not act."""
        idle = [i for i, mission in enumerate(missions) if mission.exploring and not state.option[i]]
        if not idle:
            return state
        state = state.copy()
        for i in idle:
            mission = missions[i]
            aim = mission.goal if mission.beyond is None else mission.beyond
            event = "" if state.arrived[i] == GOAL else str(state.arrived[i])
            state.begin(i, DIRECT, event, aim, mission.explore_steps)
        return state

    def with_noise(
        self, scaled: np.ndarray, missions: list[Mission], noise: ActionNoise | None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Add noise, or replace an action by a random one that is held for some steps.

        :param scaled: actions in [-1, 1], shape ``(n_envs, action_dim)``; noise is added in place
        :param missions: what each agent is about
        :param noise: to add; None for Gaussian noise
        :return: the actions, the random ones that are held, and for how many more steps
        """
        added = self.rng.normal(0.0, self.noise_std, scaled.shape) if noise is None else noise()
        noisy = scaled + added
        held, hold_left = self.held, self.hold_left.copy()
        for i, mission in enumerate(missions):
            # As in predict: only such runs go into records
            if mission.clean and not mission.random_walk:
                hold_left[i] = 0
                continue
            scaled[i] = noisy[i]
            if hold_left[i] == 0 and (mission.random_walk or self.rng.random() < self.random_action_prob / HOLD):
                held = held.copy()
                held[i] = self.rng.uniform(-1.0, 1.0, held[i].shape)
                hold_left[i] = self.rng.integers(1, 2 * HOLD)
            if hold_left[i] > 0:
                scaled[i] = held[i]
                hold_left[i] -= 1
        return np.clip(scaled, -1.0, 1.0).astype(np.float32), held, hold_left

    # -- learning -----------------------------------------------------------------------------------------------------

    def observe(self, reached: dict[str, np.ndarray], terminated: np.ndarray, dones: np.ndarray, stuck: np.ndarray) -> None:
        """Store the step once, and let everything learn from it.

        :param reached: the observations that it led to, before any reset, shapes ``(n_envs, dim)``
        :param terminated: where the environment ended for good, shape ``(n_envs,)``
        :param dones: where the episode ended for any reason
        :param stuck: where the agent can do nothing any more
        """
        step = self.pending
        assert step is not None
        points = reached["achieved_goal"]
        # Each transition is in the store once, with the point that its option aimed at
        rows = self.store.add(
            step.observation["observation"],
            step.observation["achieved_goal"],
            reached["observation"],
            points,
            step.action,
            step.state.aim,
            terminated,
            dones,
            stuck,
        )
        self.held, self.hold_left, self.pending = step.held, step.hold_left, None
        # A skill learns from its own runs more than from others
        skills = self.runner.skills
        for i, option in enumerate(step.state.option.tolist() if skills else ()):
            if option in skills:
                skills[option].replay.add_rows(rows[i : i + 1])
                self.ran[option] = self.ran.get(option, 0) + 1
        self.n_steps += len(points)
        if self.store.total - len(points) < LOOK_AT <= self.store.total:
            tell_scale(self.store, self.runner.graph.metric)
        cut = dones & ~terminated & ~stuck
        if not self.is_told_limit and cut.any():
            self.runner.planner.horizon = self.longest = max(self.longest, int(step.state.elapsed[cut].max()))
        # Which options have begun with this step, and which have ended
        for i in np.flatnonzero(step.state.steps == 1).tolist():
            self.witness.began(i, step.observation["achieved_goal"][i])
        self.state, runs = self.runner.advance(step.state, points, stuck)
        by_env = {run.env: run for run in runs}
        over = np.zeros(len(points), dtype=bool)
        for i, point in enumerate(points):
            # No event is to lie where agents get stuck.
            if not stuck[i] and self.witness.step(i, point):
                self.missions.discovered(i)
            run, mission = by_env.get(i), self.missions.current[i]
            assert mission is not None
            # A random walk is no run of anything; other runs tell what options do
            if run is not None and not mission.random_walk:
                self.witness.ended(run, clean=mission.clean)
            if run is not None and run.success and mission.exploring and not mission.random_walk:
                self._salient(point)
            # Who has something else to do now begins it without an option
            over[i] = self.missions.observe(i, point, run, bool(dones[i]))
            self.n_stuck += bool(stuck[i])
        self.hold_left = np.where(dones, 0, self.hold_left)
        if over.any():
            self.state = self.state.begun_anew(over & ~dones, same_episode=True).begun_anew(over & dones)

    def _salient(self, point: np.ndarray) -> None:
        """A proposed point was reached: it becomes a vertex, where there is none."""
        graph = self.runner.graph
        if graph.distances(point).min() > graph.metric.radius:
            self.witness.add_event(point, salient=True)

    # -- saving -------------------------------------------------------------------------------------------------------

    def get_state(self) -> dict[str, Any]:
        """Return what the environments are in the middle of, as plain data."""
        state = {"runner": tuple(self.state), "held": self.held, "hold_left": self.hold_left, "n_stuck": self.n_stuck}
        state |= {"ran": self.ran, "n_steps": self.n_steps, "longest": self.longest}
        return {**state, "missions": self.missions.get_state(), "witness": self.witness.get_state()}

    def set_state(self, state: dict[str, Any], same_envs: bool) -> None:
        """Restore what :meth:`get_state` returned.

        :param state: the state
        :param same_envs: whether the environments go on where they were; else they begin anew
        """
        self.n_stuck, self.ran, self.n_steps = state["n_stuck"], dict(state["ran"]), state["n_steps"]
        self.witness.set_state(state["witness"])
        self.missions.set_state(state["missions"])
        if not same_envs:
            self._forget()
            return
        self.longest = state["longest"]
        self.state = RunnerState(*state["runner"])
        self.held, self.hold_left = state["held"], state["hold_left"]
