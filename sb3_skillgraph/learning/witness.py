"""What trajectories and runs teach the graph: where one has been, what was crossed, how runs ended."""

from dataclasses import astuple, dataclass
from typing import Any

import numpy as np

from sb3_skillgraph.choice_model import ChoiceModel
from sb3_skillgraph.choices import EXPECTED
from sb3_skillgraph.edges import NOWHERE
from sb3_skillgraph.graph import SkillGraph
from sb3_skillgraph.learning.growth import Growth
from sb3_skillgraph.planning import DIRECT
from sb3_skillgraph.running import Run
from sb3_skillgraph.walk_model import HASTY_LOSS, Kind, timeout

#: Environment steps between two fits of the model of untried walks.
FIT_EVERY = 1_000
#: Runs of walks to goals that are remembered for it, where no edge keeps them.
N_SAMPLES = 1_000
#: Failures that nothing is known of, in the share that land far away: few say little.
FAR_PRIOR = 2.0
#: Columns of the samples: distance (event radii), whether the goal's event was where it began or somebody went there from that
#: event, success, steps; then what has to match and did not where it began.
_COLUMNS = 4


@dataclass
class _Stay:
    """A stretch of a trajectory within one event, which was reached and left when it was nearest to the event's centre.

    Of a trajectory that lingered only what lies near in time to its beginning, or to its end, counts.

    :param event: index of the event
    :param entered: step at which it began
    :param reached: step at which it was nearest to the centre, not long after it began
    :param reached_at: how near, in goal units
    :param recent: its last steps and how near to the centre each was
    """

    event: int
    entered: int
    reached: int
    reached_at: float
    recent: list[tuple[int, float]]

    def note(self, step: int, distance: float, long: int) -> None:
        """Go on.

        :param step: step of the trajectory
        :param distance: from the centre, in goal units
        :param long: how many steps are long
        """
        if distance < self.reached_at and step - self.entered <= long:
            self.reached, self.reached_at = step, distance
        self.recent = [*self.recent[-long:], (step, distance)] if long else [(step, distance)]

    @property
    def left(self) -> int:
        """Step at which it was nearest to the centre, not long before it ended: the last of equals."""
        return min(reversed(self.recent), key=lambda passed: passed[1])[0]


class Witness:
    """Watches one trajectory per environment, and writes into the graph what is learned from it.

    Steps are counted for each environment by itself. Nothing is kept that grows with experience.

    :param graph: the skill graph
    :param choice_model: what is expected of options so far, and the model of untried walks
    :param n_envs: number of environments
    :param growth: begins skills
    """

    def __init__(self, graph: SkillGraph, choice_model: ChoiceModel, n_envs: int, growth: Growth) -> None:
        self.graph = graph
        self.choice_model = choice_model
        self.growth = growth
        self._samples = np.zeros((N_SAMPLES, _COLUMNS + choice_model.model.n_matched))
        self._n_samples = 0
        self._n_steps = 0  # of all environments, since the last fit
        self.cut(n_envs)

    def cut(self, n_envs: int) -> None:
        """Forget what the environments were in the middle of.

        :param n_envs: number of environments from now on
        """
        self._stays: list[list[_Stay]] = [[] for _ in range(n_envs)]
        self._step = [0] * n_envs
        self._began = np.zeros((n_envs, self.graph.goal_dim))

    # -- trajectories -------------------------------------------------------------------------------------------------

    def begin(self, env: int, point: np.ndarray) -> None:
        """A trajectory begins.

        :param env: which environment
        :param point: where, shape ``(goal_dim,)``
        """
        if self._stays[env]:
            self._left(env)  # where the last one ended
        self._stays[env], self._step[env] = [], 0
        self._pass(env, point)

    def step(self, env: int, point: np.ndarray) -> bool:
        """A trajectory goes on.

        :param env: which environment
        :param point: where it has got to, shape ``(goal_dim,)``
        :return: whether nobody has been there before
        """
        self._step[env] += 1
        self._n_steps += 1
        is_new = self._pass(env, point)
        if self._n_steps >= FIT_EVERY:
            self._n_steps = 0
            self.fit()
            # Of the walks that are likely to succeed the long ones are kept: they make ways short
            success = self.choice_model.walks().success(EXPECTED)
            self.graph.bound_degree(success * (1.0 + self.choice_model.kinds().distance))
        return is_new

    def _pass(self, env: int, point: np.ndarray) -> bool:
        """Note in which event the trajectory is; a place that belongs to none becomes a landmark."""
        event, is_new = self.graph.locate(point), False
        if event == NOWHERE:
            n_made = self.graph.n_made
            event = self.add_event(point, salient=False)
            is_new = self.graph.n_made > n_made
        stays, step = self._stays[env], self._step[env]
        distance = float(self.graph.metric.distance(self.graph.centers[event], point))
        if stays and stays[-1].event == event:
            stays[-1].note(step, distance, (self.graph.walk_steps - 1) // 2)
            return is_new
        if stays:
            self._left(env)
        self.graph.visits[event] += 1
        self._stays[env].append(_Stay(event, step, step, distance, [(step, distance)]))
        return is_new

    def _left(self, env: int) -> None:
        """A stay is over: every event that was passed shortly before has been crossed from."""
        *earlier, last = self._stays[env]
        # The steps of a crossing are those between the centres, as near as the trajectory came to them
        recent = [stay for stay in earlier if last.reached - stay.left <= self.graph.walk_steps]
        seen = set()
        for stay in reversed(recent):
            if stay.event != last.event and stay.event not in seen:
                seen.add(stay.event)  # only the last time it was passed: a detour is no way
                self.graph.crossed(stay.event, last.event, max(last.reached - stay.left, 1))
        self._stays[env] = [*recent, last]

    def add_event(self, point: np.ndarray, *, salient: bool) -> int:
        """Add an event to the graph, which coarsens its cover where it is full.

        :param point: its centre, shape ``(goal_dim,)``
        :param salient: whether it is a target of its own
        :return: its index
        """
        while len(self.graph.events) >= self.graph.max_events:
            # Trajectories under way are in the events that others were merged into; the point may be in one, too, now
            new_index = self.graph.coarsen()
            self.growth.merged()
            for stays in self._stays:
                for stay in stays:
                    stay.event = int(new_index[stay.event])
            located = self.graph.locate(point)
            if located != NOWHERE:
                return located
        return self.graph.add_event(point, salient=salient)

    # -- runs ---------------------------------------------------------------------------------------------------------

    def began(self, env: int, point: np.ndarray) -> None:
        """A run begins.

        :param env: which environment
        :param point: where, shape ``(goal_dim,)``
        """
        self._began[env] = point

    def ended(self, run: Run, *, clean: bool = True) -> None:
        """A run has ended: its record goes to the edge it belongs to, or, to a goal, to the model of untried walks.

        :param run: what became of it
        :param clean: whether the policy acted without noise; else it tells nothing of what it can do
        """
        self.growth.ended(run)
        if not clean:
            return
        graph = self.graph
        source, target = graph.index(run.event), graph.index(run.option)
        if source != NOWHERE and target != NOWHERE and source != target:
            if graph.edges.find(source, target) is not None:
                graph.ran(source, target, run.success, graph.index(run.landing), run.steps)
            return
        if run.option == DIRECT:
            ends = run.aim, self._began[run.env]
            distance, changes = float(graph.metric.travel(*ends)), graph.metric.mismatches(*ends)
            home = graph.locate(run.aim)
            seen = source != NOWHERE and (home == source or (source, home) in graph.edges.let_go)
            row = self._n_samples % N_SAMPLES
            self._samples[row] = distance, seen, run.success, run.steps, *changes
            self._n_samples += 1

    def fit(self) -> None:
        """Learn what to expect of untried walks from all runs so far."""
        graph, edges, model = self.graph, self.graph.edges, self.choice_model.model
        aging = graph.aging()
        # Runs of walks to events are in the graph; those to goals, which no edge keeps, are kept here
        samples = self._samples[: min(self._n_samples, N_SAMPLES)]
        distance, seen, success, steps = samples[:, :_COLUMNS].T
        kinds = self.choice_model.kinds()
        known = seen * distance * model.steps_per_radius, seen, np.zeros(len(samples))
        direct = Kind(distance, *known, samples[:, _COLUMNS:] > 0.0)
        # What ran long ago, as the walker's training goes, counts less
        model.fit(
            Kind(*(np.concatenate(columns) for columns in zip(kinds, direct, strict=True))),
            np.concatenate([edges.successes * aging, success]),
            np.concatenate([edges.failures * aging, 1.0 - success]),
            np.concatenate([edges.success_steps * aging, success * steps]),
        )
        # The steps that failed runs took, beside those that they might have taken
        taken, allowed = edges.failure_steps * aging, edges.failures * timeout(self.choice_model.walks().steps) * aging
        model.fit_failures(self._far_share(kinds), float(taken.sum()), float(allowed.sum()))

    def _far_share(self, kinds: Kind) -> np.ndarray:
        """Return which share of failures lands far away, for hasty walks and for others."""
        graph, model = self.graph, self.choice_model.model
        hasty = model.is_hasty(kinds)
        failures, far = graph.edges.failures * graph.aging(), self.choice_model.far_failures(kinds)
        kinds_of_walks = ((hasty, HASTY_LOSS), (~hasty, 0.0))
        return np.array([(far[i].sum() + FAR_PRIOR * guess) / (failures[i].sum() + FAR_PRIOR) for i, guess in kinds_of_walks])

    # -- saving -------------------------------------------------------------------------------------------------------

    def get_state(self) -> dict[str, Any]:
        """Return everything as plain data."""
        return {
            "samples": self._samples[: min(self._n_samples, N_SAMPLES)].copy(),
            "n_samples": self._n_samples,
            "n_steps": self._n_steps,
            "stays": [[list(astuple(stay)) for stay in stays] for stays in self._stays],
            "step": list(self._step),
            "began": self._began.copy(),
            "growth": self.growth.get_state(),
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`get_state` returned."""
        self._n_samples, self._n_steps = state["n_samples"], state["n_steps"]
        self._samples[: len(state["samples"])] = state["samples"]
        self._stays = [[_Stay(*stay) for stay in stays] for stays in state["stays"]]
        self._step, self._began = list(state["step"]), np.array(state["began"])
        self.growth.set_state(state["growth"])
