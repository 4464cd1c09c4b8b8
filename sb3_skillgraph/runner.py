"""Running options, one environment step at a time: the same in ``learn`` and in ``predict`` (sections 3.2.4, A.6)."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from sb3_skillgraph.choices import EXPECTED, OPTIMISTIC, PESSIMISTIC, Choices, Runs, Start
from sb3_skillgraph.edges import NOWHERE
from sb3_skillgraph.graph import SkillGraph
from sb3_skillgraph.options.numpy_actor import NumpyActor
from sb3_skillgraph.options.option import Option
from sb3_skillgraph.options.views import View
from sb3_skillgraph.planning import DIRECT, GOAL, Planner, Solution
from sb3_skillgraph.running import STILL_STEPS, Run, RunnerState
from sb3_skillgraph.walk_model import timeout


class Chosen(NamedTuple):
    """An option that is to begin.

    :param option: its id
    :param event: id of the event it begins in, empty if in none
    :param aim: where it walks to, shape ``(goal_dim,)``
    :param timeout: environment steps it may run
    """

    option: str
    event: str
    aim: np.ndarray
    timeout: float


#: Chooses an option, given the state, the environment, where the agent stands, the goal and the stance.
Chooser = Callable[[RunnerState, int, np.ndarray, np.ndarray, float], Chosen]


@dataclass(eq=False, repr=False)
class Runner:
    """Lets the first option of the plan run, and plans anew when it has ended.

    It keeps nothing between calls: what must be remembered travels in :class:`RunnerState`.

    :param graph: the skill graph
    :param planner: plans over it
    :param actor: the walker's policy
    :param view: what a policy sees
    :param skills: the options that have a policy of their own, by their ids
    :param rules: what chooses options in place of the planner, if there is such a thing
    :param second: the walker's policy in the run after a failed one; None for the same
    """

    graph: SkillGraph
    planner: Planner
    actor: NumpyActor
    view: View
    skills: Mapping[str, Option] = field(default_factory=dict)
    rules: Chooser | None = None
    second: NumpyActor | None = None

    # -- one step -----------------------------------------------------------------------------------------------------

    def advance(
        self, state: RunnerState, points: np.ndarray, stuck: Sequence[bool] | np.ndarray | None = None
    ) -> tuple[RunnerState, list[Run]]:
        """End the options that have reached their termination set, have timed out, or whose agent is stuck.

        :param state: the state after the step
        :param points: where the agents stand, shape ``(n_envs, goal_dim)``
        :param stuck: which agents can do nothing any more; None for none
        :return: the state, and one run per option that has ended
        """
        runs = []
        for i, option in enumerate(state.option.tolist()):
            if not option:
                continue
            # Being stuck ends a run whatever else happens; arriving counts even at the last step
            lost = stuck is not None and bool(stuck[i])
            arrived = not lost and self._has_arrived(option, points[i], state.aim[i])
            # Its event may have been merged with others since.
            gone = option != DIRECT and option not in self.skills and self.graph.index(option) == NOWHERE
            if arrived or lost or gone or state.steps[i] >= state.timeout[i]:
                runs.append(self._run(state, i, points[i], arrived, lost))
        if runs:
            state = state.copy()
            for run in runs:
                state.end(run)
        return state, runs

    def _has_arrived(self, option: str, point: np.ndarray, aim: np.ndarray) -> bool:
        """Tell whether an option has reached its termination set."""
        if option in self.skills:
            return self.skills[option].terminates(point)
        return self.graph.metric.reached(point, aim)

    def _run(self, state: RunnerState, i: int, point: np.ndarray, arrived: bool, lost: bool) -> Run:
        option = str(state.option[i])
        index = self.graph.index(option)
        if arrived and (index != NOWHERE or option not in self.skills):
            landing = GOAL if option == DIRECT else self.graph.id(index)
        else:
            landing = "" if lost else self.graph.id(self.graph.locate(point))
        steps, aim = int(state.steps[i]), state.aim[i].copy()
        return Run(i, str(state.began[i]), option, landing, arrived, steps, aim, lost)

    def act(
        self,
        observation: dict[str, np.ndarray],
        goals: np.ndarray,
        state: RunnerState,
        stance: float = PESSIMISTIC,
        choose: Chooser | None = None,
    ) -> tuple[np.ndarray, RunnerState]:
        """Begin an option where none is running, and let the options act.

        :param observation: ``observation`` and ``achieved_goal``, shapes ``(n_envs, dim)``
        :param goals: where the agents are to go, shape ``(n_envs, goal_dim)``
        :param state: the state before the step
        :param stance: what plans count on
        :param choose: chooses an option; by default :meth:`choose`
        :return: actions scaled to [-1, 1], shape ``(n_envs, action_dim)``, and the state after the step
        """
        points = observation["achieved_goal"]
        state = state.having_seen(np.concatenate([observation["observation"], points], axis=1, dtype=np.float64))
        if self.rules is None:  # the paper's know no such thing
            state = state._replace(timeout=np.where(state.still >= STILL_STEPS, 0.0, state.timeout))
        # Where no option runs, the first of the plan begins
        idle = np.flatnonzero(state.option == "").tolist()
        if idle:
            state = state.copy()
        for i in idle:
            state.begin(i, *(choose or self.choose)(state, i, points[i], goals[i], stance))
        # All walks act by one network, in one pass for all environments; skills by their own
        seen = self.view(observation["observation"], points, state.aim)
        actions = self.walk(seen, state.failed)
        for i, option in enumerate(state.option.tolist() if self.skills else ()):
            if option in self.skills:
                actions[i] = self.skills[option].actor.act(seen[i : i + 1])[0]
        goal = goals.astype(np.float32)
        return actions, state._replace(steps=state.steps + 1, elapsed=state.elapsed + 1, goal=goal)

    def walk(self, seen: np.ndarray, failed: np.ndarray) -> np.ndarray:
        """Let the walker act.

        What failed by a policy without noise fails there again, whatever is planned: the second policy is another try.

        :param seen: what it sees, shape ``(n_envs, seen_dim)``
        :param failed: for which environments the run before this one failed, shape ``(n_envs,)``
        :return: actions scaled to [-1, 1], shape ``(n_envs, action_dim)``
        """
        actions = self.actor.act(seen)
        if self.second is None or not failed.any():
            return actions
        return np.where(failed[:, None], self.second.act(seen), actions)

    # -- choosing an option -------------------------------------------------------------------------------------------

    def start(self, state: RunnerState, i: int, point: np.ndarray) -> Start:
        """Return where the plan of an environment begins.

        That is where the running option began; if none runs, the event arrived at, else the one the agent stands in.
        """
        graph, option = self.graph, str(state.option[i])
        if option:
            towards = len(graph.events) if option == DIRECT else graph.index(option)
            return Start(point.astype(np.float64), graph.index(str(state.began[i])), towards)
        event = graph.index(str(state.arrived[i]))
        return Start(point.astype(np.float64), graph.locate(point) if event == NOWHERE else event)

    def decide(self, state: RunnerState, i: int, start: Start, goal: np.ndarray, stance: float) -> Solution:
        """Plan for one environment.

        Where everything seems lost, count on more: then a gamble is better than nothing; and where no way is known at all, get
        to where it is worth most to walk straight on.
        """
        runs = self.runs(state, i)
        stances = [stance, *(more for more in (EXPECTED, OPTIMISTIC) if more > stance)]
        for counted_on, everywhere in (*((each, False) for each in stances), (OPTIMISTIC, True)):
            solution = self.planner.solve(start, goal.astype(np.float64), runs, counted_on, everywhere)
            if solution.values[solution.start] < self.planner.lost:
                break
        return solution

    def choose(self, state: RunnerState, i: int, point: np.ndarray, goal: np.ndarray, stance: float) -> Chosen:
        """Choose the first option of the plan.

        :param state: the state before the step
        :param i: the environment
        :param point: where its agent stands, shape ``(goal_dim,)``
        :param goal: where it is to go, same shape
        :param stance: what the plan counts on
        """
        if self.rules is not None:
            return self.rules(state, i, point, goal, stance)
        start = self.start(state, i, point)
        solution = self.decide(state, i, start, goal, stance)
        return self.option_of(solution.episode, solution.first(), start, goal)

    def option_of(self, choices: Choices, row: int, start: Start, goal: np.ndarray) -> Chosen:
        """Return the option that a choice stands for.

        :param choices: what can be done
        :param row: which of them
        :param start: where
        :param goal: shape ``(goal_dim,)``
        """
        graph, target = self.graph, int(choices.target[row])
        option, aim = (DIRECT, goal) if target == len(graph.events) else (graph.walk_ids[target], graph.centers[target])
        return Chosen(option, graph.id(start.event), aim, timeout(float(choices.steps[row])))

    def choices(self, state: RunnerState, i: int, point: np.ndarray, goal: np.ndarray) -> Choices:
        """Return what can be begun in one environment: the walk straight to the goal, and walks to events.

        :param state: the state before the step; no option runs
        :param i: the environment
        :param point: where its agent stands, shape ``(goal_dim,)``
        :param goal: shape ``(goal_dim,)``
        """
        start = self.start(state, i, point)._replace(towards=len(self.graph.events))
        _, choices = self.planner.choice_model.of_episode(start, goal.astype(np.float64), self.runs(state, i))
        return choices.take(np.flatnonzero(choices.source == len(self.graph.events) + 1))

    def runs(self, state: RunnerState, i: int) -> Runs:
        """Return the episode's runs of one environment as the planner takes them; those of forgotten events are left out."""
        used = np.flatnonzero(state.run_option[i] != "").tolist()
        index, n_events, rows = self.graph.index, len(self.graph.events), []
        for slot in used:
            option, success = str(state.run_option[i, slot]), bool(state.run_success[i, slot])
            target = n_events if option == DIRECT else index(option)
            if target != NOWHERE:
                source, end = index(str(state.run_event[i, slot])), index(str(state.run_landing[i, slot]))
                rows.append((source, target, success, end, int(state.run_count[i, slot])))
        return Runs(*np.array(rows, dtype=np.int64).reshape(-1, 5).T)
