"""Choices, values and paths against what can be worked out by brute force, and plans as people see them."""

import copy
import itertools
from itertools import pairwise
from typing import Any, NamedTuple
from unittest import mock

import networkx as nx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_skillgraph import planning
from sb3_skillgraph.choice_model import BESIDE, EPISODE_WEIGHT, NEAR_EVENTS, ChoiceModel
from sb3_skillgraph.choices import EXPECTED, GUESS_RUNS, NO_RUNS, OPTIMISTIC, PESSIMISTIC, Choices, Runs, Start
from sb3_skillgraph.edges import MAX_LANDINGS, NOWHERE
from sb3_skillgraph.graph import SkillGraph
from sb3_skillgraph.plan import Plan, describe
from sb3_skillgraph.planning import FOR_GOOD, FOR_GOOD_OUTSIDE, LEAST, LOST_HORIZONS, Planner, Solution
from sb3_skillgraph.runner import Runner
from sb3_skillgraph.running import RunnerState
from sb3_skillgraph.walk_model import FIRST_GUESS, WalkModel, timeout

HORIZON = 1_000
LOST = LOST_HORIZONS * HORIZON
every_time = settings(derandomize=True, deadline=None, max_examples=40, database=None)
seeds = st.integers(0, 100_000)

# -- worlds -----------------------------------------------------------------------------------------------------------


class Given(NamedTuple):
    """Choices whose rates are known: source, target, success, steps, and where failures land with which shares."""

    source: np.ndarray
    target: np.ndarray
    success: np.ndarray
    steps: np.ndarray
    landing: np.ndarray
    share: np.ndarray

    @classmethod
    def of(cls, rows: list[tuple[int, int, float, float, list[tuple[int, float]]]]) -> "Given":
        landing, share = np.full((len(rows), MAX_LANDINGS), NOWHERE), np.zeros((len(rows), MAX_LANDINGS))
        for i, row in enumerate(rows):
            for j, (vertex, part) in enumerate(row[4]):
                landing[i, j], share[i, j] = vertex, part
        source, target, success, steps = zip(*(row[:4] for row in rows), strict=True)
        numbers = np.array(success, dtype=np.float64), np.array(steps, dtype=np.float64)
        return cls(np.array(source), np.array(target), *numbers, landing, share)

    def choices(self) -> Choices:
        """As choices that have been tried so often that nothing is left to guess."""
        failure, none = 1.0 - self.success, np.zeros(len(self.steps))
        counts = OFTEN * self.success, OFTEN * failure
        weight = OFTEN * failure[:, None] * self.share
        times = self.steps, timeout(self.steps)
        return Choices(self.source, self.target, self.success, *counts, *times, none, self.landing, weight)


class GivenChoices(ChoiceModel):
    """Knows the choices, whatever the graph says."""

    def __init__(self, n_events: int, given: Given) -> None:
        graph = SkillGraph(1, 1.0, 1000)
        for i in range(n_events):
            graph.add_event(np.array([3.0 * i]), salient=False)
        super().__init__(graph, WalkModel())
        choices = given.choices()
        between = (given.source < n_events) & (given.target < n_events)
        self.between, self.others = choices.take(np.flatnonzero(between)), choices.take(np.flatnonzero(~between))

    def walks(self) -> Choices:
        return self.between

    def of_episode(self, start: Start, goal: np.ndarray, runs: Runs, everywhere: bool = False) -> tuple[np.ndarray, Choices]:
        return np.zeros(0, dtype=np.int64), self.others


def solve(n_events: int, given: Given) -> tuple[Planner, Solution]:
    """Solve to the last step."""
    model = GivenChoices(n_events, given)
    planner = Planner(model.graph, model.model, HORIZON)
    planner.choice_model = model
    with mock.patch.object(planning, "PRECISION", 1e-9), mock.patch.object(planning, "MAX_SWEEPS", 20_000):
        return planner, planner.solve(ANYWHERE, np.zeros(1))


#: Runs of choices whose rates are known: so many that the deviation of the rate is nothing.
OFTEN = 1e12
ANYWHERE = Start(np.zeros(1), NOWHERE)


def random_rows(
    rng: np.random.Generator, n_events: int, *, elsewhere: bool, nowhere: float = 0.0, least: float = 0.2
) -> list[Any]:
    """Choices at every event and at the start, some of them to the goal.

    :param elsewhere: whether failures may land in other events
    :param nowhere: share of the choices some of whose failures are lost
    :param least: success of the worst of them
    """
    goal, start = n_events, n_events + 1
    rows = []
    for vertex in [*range(n_events), start]:
        targets = {int(t) for t in rng.integers(0, n_events, 3)} - {vertex} | ({goal} if rng.random() < 0.4 else set())
        for target in sorted(targets):
            shares = [(vertex, 1.0)]
            if elsewhere:
                parts = rng.dirichlet([1.0, 1.0, 1.0])
                lost = rng.random() < nowhere
                ends = [vertex, int(rng.integers(n_events)), NOWHERE if lost else int(rng.integers(n_events))]
                shares = list(zip(ends, parts.tolist(), strict=True))
            rows.append((vertex, target, float(rng.uniform(least, 1.0)), float(rng.integers(3, 30)), shares))
    return rows


def line_graph(n_events: int, spacing: float = 4.0) -> SkillGraph:
    graph = SkillGraph(2, 1.0, 1000)
    for i in range(n_events):
        graph.add_event(np.array([spacing * i, 0.0]), salient=False)
    return graph


def tried(graph: SkillGraph, source: int, target: int, successes: int, failures: int = 0, landing: int | None = None) -> None:
    """A crossing of 10 steps, and runs of the walk; failures land where they began unless told otherwise."""
    graph.crossed(source, target, 10)
    for _ in range(successes):
        graph.ran(source, target, True, target, 10)
    for _ in range(failures):
        graph.ran(source, target, False, source if landing is None else landing, 35)


def hopeless() -> WalkModel:
    """A model that expects nothing of walks that have not been tried, except of the last step to a goal beside an event."""
    model = WalkModel()
    model.intercept, model.coefficients[1] = -4.0, -6.0  # the more so, the longer they are
    return model


def everything(graph: SkillGraph, model: WalkModel, start: Start, goal: np.ndarray, episode: Runs = NO_RUNS) -> Choices:
    """All that can be done: the edges that the episode has shown nothing of, and what it adds."""
    choice_model = ChoiceModel(graph, model)
    replaced, added = choice_model.of_episode(start, goal, episode)
    kept = np.setdiff1d(np.arange(graph.edges.size), replaced)
    return Choices.join([choice_model.walks().take(kept), added])


def row_of(choices: Choices, source: int, target: int) -> int:
    (row,) = np.flatnonzero((choices.source == source) & (choices.target == target)).tolist()
    return int(row)


def at(graph: SkillGraph, index: int) -> Start:
    return Start(graph.centers[index].copy(), index)


def targets_on(planner: Planner, solution: Solution) -> list[int]:
    """The targets on the path of a solution's best first choice."""
    return [target for target, _ in planner.path(solution, solution.first())]


def runs(*rows: tuple[int, int, bool, int, int]) -> Runs:
    """Rows of source, target, success, landing and number."""
    return Runs(*np.array(rows, dtype=np.int64).reshape(-1, 5).T)


# -- values -----------------------------------------------------------------------------------------------------------


@every_time
@given(seeds, st.integers(1, 12))
def test_where_failures_stay_where_they_began_values_are_those_of_dijkstra(seed: int, n_events: int) -> None:
    rows = random_rows(np.random.default_rng(seed), n_events, elsewhere=False)
    _, solution = solve(n_events, Given.of(rows))
    backwards = nx.DiGraph()
    backwards.add_nodes_from(range(n_events + 2))
    for source, target, success, steps, _ in rows:
        repeated = steps + (1.0 - success) / success * float(timeout(steps))  # failures until the success
        if not backwards.has_edge(target, source) or repeated < backwards.edges[target, source]["weight"]:
            backwards.add_edge(target, source, weight=repeated)
    expected = nx.single_source_dijkstra_path_length(backwards, n_events)
    for vertex in range(n_events + 2):
        assert solution.values[vertex] == pytest.approx(min(expected.get(vertex, LOST), LOST), rel=1e-5)
    assert solution.values[solution.goal] == 0.0
    assert solution.values[NOWHERE] == LOST


def bellman(given: Given, values: np.ndarray) -> np.ndarray:
    """What each choice costs, if it is made once and everything goes on as well as may be."""
    landed = (given.share * values[given.landing]).sum(axis=1)
    costs = given.success * (given.steps + values[given.target])
    return costs + (1.0 - given.success) * (timeout(given.steps) + landed)


def brute_force(n_events: int, given: Given) -> np.ndarray:
    """The values of the best of all policies, each worked out by solving its linear equations."""
    n, at_goal = n_events + 3, n_events
    failure = 1.0 - given.success
    costs = given.success * given.steps + failure * timeout(given.steps)
    ends = np.zeros((len(costs), n))
    for row in range(len(costs)):
        ends[row, given.target[row]] += given.success[row]
        np.add.at(ends[row], given.landing[row], failure[row] * given.share[row])
    options = [np.flatnonzero(given.source == vertex).tolist() or [None] for vertex in range(n)]
    best = np.full(n, np.inf)
    for policy in itertools.product(*options):
        matrix, constant = np.eye(n), np.full(n, LOST)
        constant[at_goal] = 0.0
        for vertex, row in enumerate(policy):
            if row is not None:
                matrix[vertex] -= ends[row]
                constant[vertex] = costs[row]
        if np.linalg.cond(matrix) < 1e10:  # else it goes round for ever
            values = np.linalg.solve(matrix, constant)
            best = np.where(values >= -1e-9, np.minimum(best, values), best)
    return best


def test_where_failures_land_elsewhere_values_are_those_of_the_best_policy() -> None:
    compared = 0
    for seed in range(60):
        rng = np.random.default_rng(seed)
        rows = random_rows(rng, 4, elsewhere=True, nowhere=0.3)
        expected = brute_force(4, Given.of(rows))
        if expected.max() <= LOST + 1e-6:  # otherwise the loss is bounded, and policies are not the whole story
            _, solution = solve(4, Given.of(rows))
            np.testing.assert_allclose(solution.values, expected, rtol=1e-5, atol=1e-3)
            compared += 1
    assert compared > 20


@every_time
@given(seeds, st.integers(1, 20), st.sampled_from([0.0, 0.3, 1.0]))
def test_values_satisfy_the_bellman_equation(seed: int, n_events: int, nowhere: float) -> None:
    given_choices = Given.of(random_rows(np.random.default_rng(seed), n_events, elsewhere=True, nowhere=nowhere))
    _, solution = solve(n_events, given_choices)
    values, costs = solution.values, bellman(given_choices, solution.values)
    for vertex in np.unique(given_choices.source):
        least = costs[given_choices.source == vertex].min()
        assert values[vertex] == pytest.approx(min(least, LOST), rel=1e-5, abs=1e-3)
    assert ((values >= 0.0) & (values <= LOST)).all()


@every_time
@given(seeds, st.integers(2, 15))
def test_values_are_as_good_with_the_precision_that_plans_are_made_with(seed: int, n_events: int) -> None:
    given_choices = Given.of(random_rows(np.random.default_rng(seed), n_events, elsewhere=True, nowhere=0.2))
    planner, exact = solve(n_events, given_choices)
    quick = planner.solve(ANYWHERE, np.zeros(1))
    assert (quick.values >= exact.values - 1e-3).all()  # from above
    np.testing.assert_allclose(quick.values, exact.values, rtol=0.02, atol=5.0)


def test_a_vertex_from_which_nothing_leads_to_the_goal_is_as_good_as_lost() -> None:
    planner, solution = solve(
        3, Given.of([(4, 0, 1.0, 5.0, [(4, 1.0)]), (1, 2, 1.0, 5.0, [(1, 1.0)]), (0, 3, 1.0, 5.0, [(0, 1.0)])])
    )
    assert solution.values[[0, 4]] == pytest.approx([5.0, 10.0])
    assert solution.values[[1, 2]].tolist() == [LOST, LOST]
    assert planner.path(solution, solution.first()) == [(0, 0), (3, 3)]


def test_a_run_that_always_fails_where_it_began_is_no_way() -> None:
    _, solution = solve(1, Given.of([(2, 1, 0.0, 5.0, [(2, 1.0)])]))
    assert solution.values[solution.start] > 0.99 * LOST
    assert solution.first() == 0  # it is tried all the same


# -- ties and purity --------------------------------------------------------------------------------------------------


def test_of_equal_choices_the_first_is_taken_and_at_the_start_the_walk_to_the_goal() -> None:
    def targets(*rows: Any) -> list[int]:
        return targets_on(*solve(3, Given.of([(v, t, 1.0, steps, [(v, 1.0)]) for v, t, steps in rows])))

    onward = [(v, 3, 7.0) for v in (0, 1, 2)]
    assert targets((4, 0, 5.0), (4, 1, 5.0), *onward) == [0, 3]
    assert targets((4, 1, 5.0), (4, 0, 5.0), *onward) == [1, 3]
    assert targets((4, 0, 5.0), (4, 1, 5.0), (4, 3, 12.0), *onward) == [3]
    assert targets((4, 0, 5.0), (4, 1, 5.0), (4, 3, 12.5), *onward) == [0, 3]
    assert targets((4, 0, 5.0), (0, 1, 5.0), (0, 2, 5.0), *onward[1:]) == [0, 1, 3]
    assert targets((4, 0, 5.0), (0, 2, 5.0), (0, 1, 5.0), *onward[1:]) == [0, 2, 3]


def test_a_solution_depends_on_nothing_that_was_asked_before() -> None:
    rng = np.random.default_rng(3)
    graph, model = random_graph(rng, 12), WalkModel()
    goals = rng.uniform(0.0, 12.0, (40, 2))
    one = Planner(graph, model, HORIZON)
    in_order = [one.solve(at(graph, i % 12), goal) for i, goal in enumerate(goals)]
    other = Planner(graph, model, HORIZON)
    for i in rng.permutation(40).tolist():
        solution = other.solve(at(graph, i % 12), goals[i])
        np.testing.assert_array_equal(solution.values, in_order[i].values)
        np.testing.assert_array_equal(solution.walk_costs, in_order[i].walk_costs)
        np.testing.assert_array_equal(solution.episode_costs, in_order[i].episode_costs)
        assert solution.first() == in_order[i].first()


def test_a_new_run_or_crossing_is_heeded_at_once() -> None:
    graph = line_graph(2)
    tried(graph, 0, 1, 5)
    planner = Planner(graph, hopeless(), HORIZON)
    before = planner.solve(at(graph, 0), graph.centers[1]).values[0]
    assert planner.solve(at(graph, 0), graph.centers[1]).values[0] == before
    for _ in range(5):
        graph.ran(0, 1, False, 0, 35)
    assert planner.solve(at(graph, 0), graph.centers[1]).values[0] > before + 10.0


def random_graph(rng: np.random.Generator, n_events: int) -> SkillGraph:
    graph = SkillGraph(2, 1.0, 1000)
    for _ in range(n_events):
        graph.add_event(rng.uniform(0.0, 12.0, 2), salient=False)
    for _ in range(4 * n_events):
        source, target = rng.integers(0, n_events, 2).tolist()
        if source != target:
            graph.crossed(source, target, float(rng.integers(2, 40)))
            for _ in range(rng.integers(0, 4)):
                success = bool(rng.random() < 0.7)
                landing = target if success else int(rng.integers(-1, n_events))
                graph.ran(source, target, success, landing, int(rng.integers(2, 40)))
    return graph


def random_runs(rng: np.random.Generator, n_events: int, n_runs: int) -> Runs:
    source, target = rng.integers(-1, n_events, n_runs), rng.integers(0, n_events + 1, n_runs)
    success = rng.random(n_runs) < 0.3
    landing = np.where(success, target % n_events, rng.integers(-1, n_events, n_runs))
    return Runs(source, target, success.astype(np.int64), landing, rng.integers(1, 4, n_runs))


def random_question(rng: np.random.Generator, graph: SkillGraph) -> tuple[Start, np.ndarray, Runs, float]:
    n = len(graph.events)
    point = rng.uniform(-3.0, 15.0, 2)
    event = int(rng.integers(n)) if rng.random() < 0.3 else graph.locate(point)
    stance = (OPTIMISTIC, EXPECTED, PESSIMISTIC)[rng.integers(3)]
    towards = int(rng.integers(n + 1)) if rng.random() < 0.5 else NOWHERE
    start = Start(point, event, towards)
    return start, rng.uniform(-3.0, 15.0, 2), random_runs(rng, n, int(rng.integers(0, 6))), stance


# -- choices ----------------------------------------------------------------------------------------------------------


@every_time
@given(seeds, st.integers(1, 15))
def test_choices_are_well_formed_and_there_is_one_at_every_start(seed: int, n_events: int) -> None:
    rng = np.random.default_rng(seed)
    graph = random_graph(rng, n_events)
    start, goal, episode, stance = random_question(rng, graph)
    found = everything(graph, WalkModel(), start, goal, episode)
    assert len({len(column) for column in found}) == 1
    success, (landing, share) = found.success(stance), found.landings()
    assert ((success >= 0.0) & (success <= 1.0)).all()
    assert (np.isfinite(found.steps) & (found.steps >= 1.0)).all()
    np.testing.assert_allclose(share.sum(axis=1), 1.0)
    assert (share >= 0.0).all()
    at_start = found.source == n_events + 1
    lands = np.where(share > 0.0, landing, NOWHERE)
    assert ((lands[~at_start] >= NOWHERE) & (lands[~at_start] < n_events)).all()
    assert at_start.any()
    if start.towards != NOWHERE:
        assert (found.target[at_start] == start.towards).sum() == 1  # what runs can go on
    assert not (found.target == n_events + 1).any()
    assert at_start[-at_start.sum() :].all()  # the last rows
    pairs = list(zip(found.source.tolist(), found.target.tolist(), strict=True))
    assert len(pairs) == len(set(pairs))


@every_time
@given(seeds, st.integers(1, 15))
def test_planning_changes_nothing(seed: int, n_events: int) -> None:
    rng = np.random.default_rng(seed)
    graph, model = random_graph(rng, n_events), WalkModel()
    state, known, version = copy.deepcopy(graph.get_state()), copy.deepcopy(model.get_state()), graph.version
    planner = Planner(graph, model, HORIZON)
    for _ in range(4):
        start, goal, episode, stance = random_question(rng, graph)
        question = copy.deepcopy((start, goal, episode))
        solution = planner.solve(start, goal, episode, stance)
        planner.path(solution, solution.first())
        planner.promise(solution, solution.first(), 500.0)
        np.testing.assert_equal((start, goal, episode), question)
    np.testing.assert_equal(graph.get_state(), state)
    np.testing.assert_equal(model.get_state(), known)
    assert graph.version == version


def test_an_untried_walk_is_as_good_as_those_of_its_kind() -> None:
    def rate_of_untried(failures: int) -> float:
        graph, model = line_graph(8), WalkModel()
        for source, target in ((0, 1), (1, 2), (2, 3)):
            tried(graph, source, target, 30 - failures, failures)
        graph.crossed(5, 6, 10)
        edges = graph.edges
        model.fit(ChoiceModel(graph, model).kinds(), edges.successes, edges.failures, edges.success_steps)
        walks = ChoiceModel(graph, model).walks()
        assert walks.successes[edges.find(5, 6)] == walks.failures[edges.find(5, 6)] == 0.0
        return float(walks.success(EXPECTED)[edges.find(5, 6)])

    assert rate_of_untried(1) > 0.8
    assert rate_of_untried(29) < 0.2


def test_choosing_is_optimistic_or_pessimistic_about_what_is_unknown() -> None:
    graph = line_graph(3)
    tried(graph, 0, 1, 2, 2)
    tried(graph, 1, 2, 200, 200)
    walks = ChoiceModel(graph, WalkModel()).walks()
    few, many = graph.edges.find(0, 1), graph.edges.find(1, 2)
    low, mean, high = (walks.success(stance) for stance in (PESSIMISTIC, EXPECTED, OPTIMISTIC))
    assert mean[few] == pytest.approx((GUESS_RUNS * walks.guess[few] + 2.0) / (GUESS_RUNS + 4.0))
    assert low[few] < mean[few] < high[few]
    assert high[few] - low[few] > 5.0 * (high[many] - low[many]) > 0.0


def test_a_record_that_has_aged_says_less() -> None:
    graph = line_graph(2)
    tried(graph, 0, 1, 0, 20)
    row = graph.edges.find(0, 1)
    model = ChoiceModel(graph, WalkModel())
    young = model.walks().success(EXPECTED)[row]
    graph.now = 50_000.0
    old = ChoiceModel(graph, WalkModel()).walks().success(EXPECTED)[row]
    assert young < 0.05 < 0.2 < old < FIRST_GUESS


def test_what_training_has_shown_is_told_as_of_now() -> None:
    graph = line_graph(2)
    tried(graph, 0, 1, 0, 20)
    model = ChoiceModel(graph, WalkModel())
    model.walks()
    graph.now = 50_000.0
    for known, made_now in zip(model.walks(), ChoiceModel(graph, WalkModel()).walks(), strict=True):
        np.testing.assert_array_equal(known, made_now)


def test_an_untried_walk_is_judged_by_those_that_share_an_event_with_it_and_are_hasty_as_it_is() -> None:
    def rates(hasty: bool, source: int, target: int) -> tuple[float, float]:
        graph, model = line_graph(8), WalkModel()
        model.fastest = 5.0  # steps for a radius: 20 from one event to the next
        for pair, steps in (((0, 1), 20), ((0, 3), 2)):
            graph.crossed(*pair, steps)
        for untried in ((0, 2), (4, 1), (5, 6)):
            graph.crossed(*untried, 2 if hasty else 60)
        guess = ChoiceModel(graph, model).walks().guess[graph.edges.find(source, target)]
        for _ in range(30):
            graph.ran(0, 1, True, 1, 20)
        return float(guess), float(ChoiceModel(graph, model).walks().guess[graph.edges.find(source, target)])

    for source, target in ((0, 2), (4, 1)):  # out of the same event, into the same one
        before, after = rates(False, source, target)
        assert after > before + 0.1
        before, after = rates(True, source, target)
        assert after == before
    before, after = rates(False, 5, 6)
    assert after == before


def test_a_walk_that_failed_early_in_training_is_tried_again_when_its_kind_has_come_to_succeed() -> None:
    graph = SkillGraph(2, 1.0, 100)
    around = [(4.0 + 2.0 * np.cos(angle), 2.0 * np.sin(angle)) for angle in (-1.5, -0.75, 0.0, 0.75, 1.5)]
    for place in ((0.0, 0.0), (4.0, 0.0), (0.0, 4.0), (0.0, 8.0), (4.0, 8.0), *around):
        graph.add_event(np.array(place), salient=False)
    detour, goal = ((0, 2), (2, 3), (3, 4), (4, 1)), len(graph.events)
    tried(graph, 0, 1, 0, 20)  # the short way; to the other events around the goal there is none
    for pair in detour:
        tried(graph, *pair, 5)
    model = WalkModel()
    planner = Planner(graph, model, HORIZON)

    def fit() -> None:
        edges, aging = graph.edges, graph.aging()
        weights = edges.successes * aging, edges.failures * aging, edges.success_steps * aging
        model.fit(planner.choice_model.kinds(), *weights)

    fit()
    assert targets_on(planner, planner.solve(at(graph, 0), graph.centers[1]))[0] == 2
    graph.now = 40_000.0  # updates of the walker later, walks of this length succeed
    for pair in detour:
        tried(graph, *pair, 10)
    fit()
    assert targets_on(planner, planner.solve(at(graph, 0), graph.centers[1]))[0] in (1, goal)
    row = graph.edges.find(0, 1)
    before = planner.choice_model.walks().success(EXPECTED)[row]
    for _ in range(2):
        graph.ran(0, 1, True, 1, 10)  # and it does
    assert planner.choice_model.walks().success(EXPECTED)[row] > max(before, 0.7)


def test_runs_of_the_episode_count_more_than_those_of_training() -> None:
    graph, model = line_graph(3), WalkModel()
    tried(graph, 0, 1, 3, 1, landing=2)
    start, goal = at(graph, 2), np.array([50.0, 0.0])
    found = everything(graph, model, start, goal, runs((0, 1, False, NOWHERE, 2), (0, 1, True, 1, 1)))
    row = row_of(found, 0, 1)
    guess = GUESS_RUNS * found.guess[row]
    expected = (guess + 3.0 + EPISODE_WEIGHT) / (GUESS_RUNS + 4.0 + 3.0 * EPISODE_WEIGHT)
    assert found.success(EXPECTED)[row] == pytest.approx(expected)
    landing, share = found.landings()
    there = share[row][landing[row] == 2].sum()
    assert there == pytest.approx(1.0 / (2.0 + 2.0 * EPISODE_WEIGHT))  # one failure's worth for its kind
    assert share[row][landing[row] == NOWHERE].sum() >= 2.0 * EPISODE_WEIGHT * there
    untouched = everything(graph, model, start, goal)
    expected = (guess + 3.0) / (GUESS_RUNS + 4.0)
    assert untouched.success(EXPECTED)[row_of(untouched, 0, 1)] == pytest.approx(expected)


def test_a_rare_landing_that_gives_way_to_a_new_one_takes_its_runs_along() -> None:
    graph = line_graph(8)
    for landing in range(2, 2 + MAX_LANDINGS):
        tried(graph, 0, 1, 0, 6, landing=landing)
    found = everything(graph, WalkModel(), at(graph, 7), np.array([90.0, 0.0]), runs((0, 1, False, 6, 1)))
    row = row_of(found, 0, 1)
    weights = found.weight[row]
    assert weights[found.landing[row] == 6].tolist() == [EPISODE_WEIGHT]  # those of another event are not its own
    assert weights.sum() == pytest.approx(6.0 * (MAX_LANDINGS - 1) + EPISODE_WEIGHT)
    assert found.failures[row] == pytest.approx(6.0 * MAX_LANDINGS + EPISODE_WEIGHT)  # that they failed is not forgotten


def test_a_goal_beside_an_event_can_be_reached_from_wherever_the_event_can() -> None:
    graph = line_graph(12)
    for i in range(11):
        tried(graph, i, 11, 5)
    found = everything(graph, WalkModel(), at(graph, 0), np.array([44.5, 0.0]))
    assert set(found.source[found.target == 12].tolist()) == {*range(12), 13}
    success = found.success(EXPECTED)
    assert success[row_of(found, 13, 12)] == success[row_of(found, 0, 12)]
    assert success[row_of(found, 0, 12)] == pytest.approx(BESIDE * success[row_of(found, 0, 11)], rel=0.02)


def test_a_goal_is_as_hard_to_reach_as_the_event_that_it_lies_in() -> None:
    graph = line_graph(8)
    tried(graph, 0, 1, 0, 20, landing=2)
    tried(graph, 2, 1, 20)
    found = everything(graph, WalkModel(), at(graph, 0), graph.centers[1])
    success = found.success(EXPECTED)
    for source in (0, 2):  # both of them near enough for a guess
        walk, to_goal = row_of(found, source, 1), row_of(found, source, 8)
        assert success[to_goal] == pytest.approx(BESIDE * success[walk], rel=0.02)
        assert found.failures[to_goal] == found.failures[walk]
        np.testing.assert_array_equal(found.landing[to_goal], found.landing[walk])
        np.testing.assert_array_equal(found.weight[to_goal], found.weight[walk])
    assert success[row_of(found, 0, 8)] < 0.1 < 0.8 < success[row_of(found, 2, 8)]


def test_what_an_episode_shows_of_the_walk_to_an_event_counts_for_a_goal_in_it_too() -> None:
    graph = line_graph(8)
    tried(graph, 0, 1, 4)
    goal = graph.centers[1]

    def rate(*shown: tuple[int, int, bool, int, int]) -> float:
        found = everything(graph, WalkModel(), at(graph, 0), goal, runs(*shown))
        return float(found.success(EXPECTED)[row_of(found, 0, 8)])

    assert rate((0, 1, False, 0, 3)) < rate() - 0.2
    assert rate((0, 8, False, 0, 3)) == pytest.approx(rate((0, 1, False, 0, 3)))
    assert rate((0, 1, False, 0, 3), (0, 8, False, 0, 3)) < rate((0, 1, False, 0, 3)) - 0.1


def test_a_goal_in_no_event_can_be_tried_from_the_events_near_enough_to_walk_from() -> None:
    graph = line_graph(12)
    for y, near in ((5.0, [10, 11]), (60.0, [11])):  # the model takes 5 steps for a radius, and a walk 40 at most
        for start, also in ((0, []), (11, [13])):
            tried(graph, 0, 1, 1)
            found = everything(graph, WalkModel(), at(graph, start), np.array([44.0, y]))
            assert sorted(found.source[found.target == 12].tolist()) == near + also


def test_the_walk_to_a_goal_far_away_is_begun_only_where_there_is_nothing_else_to_do() -> None:
    graph = line_graph(12)
    tried(graph, 0, 1, 1)
    for start, expected in ((0, [1]), (5, [12])):
        found = everything(graph, WalkModel(), at(graph, start), np.array([44.0, 9.0]))
        assert found.target[found.source == 13].tolist() == expected


def test_that_there_is_no_edge_tells_nothing_of_a_walk_where_it_was_let_go() -> None:
    graph, model = line_graph(4, 3.0), WalkModel()
    model.coefficients[5] = -4.0  # of walks where nobody was seen to go
    graph.crossed(0, 1, 10)
    goal = graph.centers[2] + [0.5, 0.0]

    def guess() -> float:
        found = everything(graph, model, at(graph, 0), goal)
        return float(found.guess[row_of(found, 5, 4)])

    assert guess() < 0.02
    graph.crossed(0, 2, 20)
    graph.edges.keep(np.arange(2))
    assert guess() == pytest.approx(FIRST_GUESS)
    # Like an untried walk that an edge stands for it is judged by what others do from the same event
    tried(graph, 0, 1, 10)
    assert guess() > FIRST_GUESS + 0.2
    graph.crossed(0, 3, 30)
    assert guess() == ChoiceModel(graph, model).walks().guess[-2]


def test_a_record_that_is_bad_is_no_reason_to_guess() -> None:
    graph = line_graph(3)
    tried(graph, 0, 1, 1, 40)
    for _ in range(30):
        graph.ran(0, 1, True, 1, 60)
        graph.ran(0, 1, False, 0, 60)
    goal = graph.centers[1] + [0.5, 0.0]
    found = everything(graph, WalkModel(), at(graph, 0), goal)
    (row,) = np.flatnonzero((found.source == 4) & (found.target == 3))
    assert found.steps[row] > graph.walk_steps  # longer than walks are, but it is what was seen
    assert found.failures[row] == pytest.approx(70.0)


def test_who_is_nowhere_can_walk_to_the_nearest_events() -> None:
    graph = line_graph(12)
    start = Start(np.array([20.5, 5.0]), NOWHERE)
    near = np.argsort(graph.distances(start.point))[:NEAR_EVENTS].tolist()
    for goal, also in (([44.0, 0.0], []), ([24.0, 5.0], [12])):
        found = everything(graph, WalkModel(), start, np.array(goal))
        assert sorted(found.target[found.source == 13].tolist()) == [*sorted(near), *also]


def test_who_is_at_the_edge_of_an_event_can_walk_to_its_middle() -> None:
    graph = line_graph(3)
    for x, expected in ((1.3, True), (0.7, False)):
        found = everything(graph, WalkModel(), Start(np.array([x, 0.0]), 0), np.array([8.0, 0.0]))
        assert bool((found.target[found.source == 4] == 0).any()) is expected


def test_what_can_be_done_in_an_event_can_be_done_by_who_is_there() -> None:
    graph = line_graph(4)
    for target in (1, 2):
        tried(graph, 0, target, target, 1)
    found = everything(graph, WalkModel(), at(graph, 0), np.array([8.0, 9.0]), runs((0, 2, False, 3, 1)))
    assert sorted(found.target[found.source == 5].tolist()) == [1, 2]
    for target in (1, 2):
        there, here = row_of(found, 0, target), row_of(found, 5, target)
        for name in ("guess", "successes", "failures", "steps", "loss", "landing", "weight"):
            column = getattr(found, name)
            np.testing.assert_array_equal(column[there], column[here])


def test_an_option_that_runs_can_go_on_where_it_could_not_be_begun() -> None:
    graph = line_graph(12)
    for event in (0, NOWHERE):
        for towards, known in ((11, False), (1, event == NOWHERE), (12, event == 0), (NOWHERE, True)):
            others = everything(graph, WalkModel(), Start(np.zeros(2), event), np.array([20.0, 9.0]))
            found = everything(graph, WalkModel(), Start(np.zeros(2), event, towards), np.array([20.0, 9.0]))
            targets, added = found.target[found.source == 13].tolist(), [] if known else [towards]
            assert targets == [*others.target[others.source == 13].tolist(), *added]


# -- which way --------------------------------------------------------------------------------------------------------


def gamble(detour: bool) -> SkillGraph:
    """From the first event to the last: a walk that may be lost, and three sure ones by way of the others."""
    graph = line_graph(4)
    tried(graph, 0, 3, 20, 5, landing=NOWHERE)
    if detour:
        for i in range(3):
            tried(graph, i, i + 1, 30)
    return graph


def test_a_safe_detour_beats_a_gamble_that_may_land_nowhere() -> None:
    graph = gamble(detour=True)
    planner = Planner(graph, hopeless(), HORIZON)
    solution = planner.solve(at(graph, 0), graph.centers[3])
    assert targets_on(planner, solution) == [1, 2, 3, 4]
    row = row_of(solution.episode, solution.start, 3)
    assert solution.episode_costs[row] > solution.values[solution.start]


def test_a_gamble_is_taken_where_nothing_safe_leads_there() -> None:
    graph = gamble(detour=False)
    planner = Planner(graph, hopeless(), HORIZON)
    solution = planner.solve(at(graph, 0), graph.centers[3])
    assert targets_on(planner, solution) == [3, 4]
    assert solution.values[solution.start] < LOST


def test_a_detour_that_fails_in_this_episode_is_left() -> None:
    graph = line_graph(5)
    for source, target in ((0, 1), (1, 4), (0, 2), (2, 3), (3, 4)):
        tried(graph, source, target, 8)
    planner = Planner(graph, hopeless(), HORIZON)
    goal = graph.centers[4]
    assert targets_on(planner, planner.solve(at(graph, 0), goal)) == [1, 5]
    failed = planner.solve(at(graph, 0), goal, runs((0, 1, False, 0, 4)))
    assert targets_on(planner, failed) == [2, 3, 5]
    both = planner.solve(at(graph, 0), goal, runs((0, 1, False, 0, 4), (0, 2, False, 0, 40)))
    assert targets_on(planner, both)[0] == 1  # the lesser evil


# -- paths ------------------------------------------------------------------------------------------------------------


def test_a_path_follows_the_likeliest_landing_of_lower_value() -> None:
    rows = [
        (4, 0, 0.3, 10.0, [(1, 0.9), (NOWHERE, 0.1)]),  # from the start: mostly ends in the second event
        (0, 3, 1.0, 10.0, [(0, 1.0)]),
        (1, 2, 0.4, 10.0, [(1, 1.0)]),
        (2, 3, 0.9, 10.0, [(0, 1.0)]),
    ]
    planner, solution = solve(3, Given.of(rows))
    assert planner.path(solution, solution.first()) == [(0, 1), (2, 2), (3, 3)]


def test_a_path_does_not_go_where_it_is_further() -> None:
    rows = [
        (4, 0, 0.9, 10.0, [(4, 1.0)]),
        (0, 3, 0.2, 10.0, [(1, 1.0)]),  # mostly thrown back, to where it is a long way
        (1, 0, 1.0, 50.0, [(1, 1.0)]),
    ]
    planner, solution = solve(3, Given.of(rows))
    assert solution.values[1] > solution.values[0]
    assert planner.path(solution, solution.first()) == [(0, 0), (3, 3)]


def test_a_path_goes_on_where_an_option_leads_that_is_not_the_best() -> None:
    rows = [
        (4, 0, 0.3, 10.0, [(4, 1.0)]),  # mostly fails, and the best can be begun instead
        (4, 1, 1.0, 5.0, [(4, 1.0)]),
        (0, 3, 1.0, 30.0, [(0, 1.0)]),
        (1, 3, 1.0, 5.0, [(1, 1.0)]),
    ]
    planner, solution = solve(3, Given.of(rows))
    assert solution.first() == 1
    assert planner.path(solution, 0) == [(0, 0), (3, 3)]


def test_a_path_names_no_option_twice() -> None:
    rows = [
        (3, 0, 0.3, 10.0, [(1, 1.0)]),  # it is followed to the second event, where the best is the same option
        (0, 2, 1.0, 10.0, [(0, 1.0)]),
        (1, 0, 1.0, 10.0, [(1, 1.0)]),
    ]
    planner, solution = solve(2, Given.of(rows))
    assert solution.values[1] < solution.episode_costs[0]
    assert planner.path(solution, 0) == [(0, 1), (2, 2)]


def test_a_path_ends_with_the_walk_to_the_goal_even_where_nothing_leads_there() -> None:
    planner, solution = solve(2, Given.of([(3, 0, 1.0, 5.0, [(3, 1.0)]), (0, 1, 1.0, 5.0, [(0, 1.0)])]))
    assert solution.values[solution.start] == LOST
    assert planner.path(solution, 0) == [(0, 0), (2, 2)]


def check_path(solution: Solution, path: list[tuple[int, int]]) -> None:
    """A path ends with the walk to the goal, and neither an option nor an event comes twice."""
    targets, ends = [target for target, _ in path], [end for _, end in path]
    assert path[-1] == (solution.goal, solution.goal)
    assert len(set(targets)) == len(targets)
    assert len(set(ends)) == len(ends)
    assert all(0 <= vertex < solution.goal for pair in path[:-1] for vertex in pair)


@every_time
@given(seeds, st.integers(1, 15), st.sampled_from([0.0, 0.3, 1.0]))
def test_no_path_comes_past_a_vertex_twice_whatever_it_begins_with(seed: int, n_events: int, nowhere: float) -> None:
    rows = random_rows(np.random.default_rng(seed), n_events, elsewhere=True, nowhere=nowhere, least=0.05)
    planner, solution = solve(n_events, Given.of(rows))
    for first in np.flatnonzero(solution.episode.source == solution.start).tolist():
        check_path(solution, planner.path(solution, first))


@every_time
@given(seeds, st.integers(1, 20))
def test_paths_lead_down_to_the_goal_without_cycles(seed: int, n_events: int) -> None:
    rows = random_rows(np.random.default_rng(seed), n_events, elsewhere=False)
    planner, solution = solve(n_events, Given.of(rows))
    hopeful = (solution.episode.source == solution.start) & (solution.episode_costs < 0.9 * LOST)
    for first in np.flatnonzero(hopeful).tolist():
        steps = planner.path(solution, first)
        path = [target for target, _ in steps]
        assert steps == [(target, target) for target in path]
        assert path[0] == solution.episode.target[first]
        assert len(set(path)) == len(path)
        values = solution.values[path].tolist()
        assert values == sorted(set(values), reverse=True)
        for vertex, target in pairwise(path):
            assert target in [row[1] for row in rows if row[0] == vertex]
        assert path[-1] == solution.goal
        costs = {(row[0], row[1]): row[3] + (1.0 - row[2]) / row[2] * float(timeout(row[3])) for row in rows}
        total = sum(costs[pair] for pair in pairwise([solution.start, *path]))
        assert solution.episode_costs[first] == pytest.approx(total, rel=1e-5)


@every_time
@given(seeds, st.integers(1, 15))
def test_on_every_graph_there_is_a_path_to_every_goal(seed: int, n_events: int) -> None:
    rng = np.random.default_rng(seed)
    graph = random_graph(rng, n_events)
    planner = Planner(graph, WalkModel(), HORIZON)
    start, goal, episode, stance = random_question(rng, graph)
    solution = planner.solve(start, goal, episode, stance)
    for first in np.flatnonzero(solution.episode.source == solution.start).tolist():
        path = planner.path(solution, first)
        assert path[0][0] == solution.episode.target[first]
        check_path(solution, path)
    probability, steps = planner.promise(solution, solution.first(), float(HORIZON))
    assert LEAST <= probability <= 1.0
    assert 0.0 <= steps <= HORIZON


# -- what is promised -------------------------------------------------------------------------------------------------


def simulate(given: Given, best: dict[int, int], start: int, goal: int, remaining: float, n: int) -> tuple[float, float]:
    """Success within the remaining steps, and mean steps of those that succeed, by playing it; some failures are for good."""
    rng, arrivals = np.random.default_rng(0), []
    for _ in range(n):
        vertex, time = start, 0.0
        while vertex in best and time < remaining:
            row = best[vertex]
            if rng.random() < given.success[row]:
                vertex, time = int(given.target[row]), time + given.steps[row]
            elif rng.random() < FOR_GOOD * (1.0 - given.success[row]):
                break
            else:
                vertex = int(rng.choice(given.landing[row], p=given.share[row]))
                time += float(timeout(given.steps[row]))
        if vertex == goal and time <= remaining:
            arrivals.append(time)
    return len(arrivals) / n, float(np.mean(arrivals)) if arrivals else 0.0


@pytest.mark.parametrize("seed", range(8))
def test_a_promise_is_what_happens_when_it_is_played(seed: int) -> None:
    rng = np.random.default_rng(seed)
    given_choices = Given.of(random_rows(rng, 6, elsewhere=True, nowhere=0.4))
    planner, solution = solve(6, given_choices)
    remaining = float(rng.choice([150.0, 300.0, 1_000.0]))
    probability, steps = planner.promise(solution, solution.first(), remaining)
    costs = bellman(given_choices, solution.values)
    best = {
        v: min(np.flatnonzero(given_choices.source == v), key=costs.__getitem__) for v in set(given_choices.source.tolist())
    }
    played, mean = simulate(given_choices, best, solution.start, solution.goal, remaining, 3_000)
    assert probability == pytest.approx(played, abs=0.05)
    if played > 0.2:
        assert steps == pytest.approx(mean, rel=0.1)


def test_a_promise_is_about_the_option_that_runs_not_about_the_best() -> None:
    rows = [
        (3, 0, 1.0, 10.0, [(3, 1.0)]),
        (3, 1, 0.5, 10.0, [(NOWHERE, 1.0)]),
        (0, 2, 1.0, 10.0, [(0, 1.0)]),
        (1, 2, 1.0, 10.0, [(1, 1.0)]),
    ]
    planner, solution = solve(2, Given.of(rows))
    sure, steps = planner.promise(solution, 0, 400.0)
    assert (sure, steps) == (pytest.approx(1.0), pytest.approx(20.0, abs=3.0))
    assert planner.promise(solution, 1, 400.0)[0] == pytest.approx(0.5)


def test_less_time_promises_less() -> None:
    rows = [(3, 2, 0.3, 10.0, [(3, 1.0)])]
    planner, solution = solve(2, Given.of(rows))
    promised = [planner.promise(solution, 0, remaining)[0] for remaining in (20.0, 50.0, 100.0, 2_000.0)]
    assert promised == sorted(promised)
    assert promised[0] == pytest.approx(0.3, abs=0.01)
    assert promised[-1] == pytest.approx(0.3 / (1.0 - 0.7 * (1.0 - 0.7 * FOR_GOOD)), abs=0.01)


def test_a_walk_to_where_nobody_has_been_that_fails_fails_more_often_for_good() -> None:
    rows = [(3, 0, 0.5, 10.0, [(3, 1.0)]), (0, 2, 0.3, 10.0, [(0, 1.0)])]
    planner, solution = solve(2, Given.of(rows))
    # The walk to the goal alone: who has not got to where it begins tries again as ever
    for outside, for_good in ((False, FOR_GOOD), (True, FOR_GOOD_OUTSIDE)):
        expected = 0.5 / (1.0 - 0.5 * (1.0 - 0.5 * FOR_GOOD)) * 0.3 / (1.0 - 0.7 * (1.0 - 0.7 * for_good))
        assert planner.promise(solution, 0, 4_000.0, outside)[0] == pytest.approx(expected, abs=0.01)


@pytest.mark.parametrize(("guess", "sign"), [(0.95, -1.0), (0.05, 1.0)])
def test_where_there_have_hardly_been_runs_promises_are_less_sure(guess: float, sign: float) -> None:
    planner, solution = solve(2, Given.of([(3, 2, guess, 10.0, [(NOWHERE, 1.0)])]))
    none = np.zeros(1)
    untried = solution._replace(
        episode=solution.episode._replace(successes=none, failures=none, loss=np.ones(1), weight=np.zeros((1, MAX_LANDINGS)))
    )
    promised = []
    for n_runs in (0.0, 10.0, 1_000.0):
        planner.choice_model.model.n_runs = n_runs
        promised.append(planner.promise(untried, 0, 500.0)[0])
    assert all(sign * nearer > sign * further + 0.01 for nearer, further in pairwise(promised))


@pytest.mark.parametrize("remaining", [1.0, 5.0, 9.0])
def test_nothing_is_impossible(remaining: float) -> None:
    planner, solution = solve(2, Given.of([(3, 2, 0.3, 10.0, [(3, 1.0)])]))
    assert planner.promise(solution, 0, remaining) == (LEAST, solution.values[solution.start])


def test_what_is_sure_is_promised_as_sure_and_no_more() -> None:
    planner, solution = solve(2, Given.of([(3, 0, 1.0, 7.0, [(3, 1.0)]), (0, 2, 1.0, 7.0, [(0, 1.0)])]))
    for remaining in np.linspace(30.0, 1_000.0, 40).tolist():
        probability, steps = planner.promise(solution, 0, remaining)
        assert 1.0 - 1e-6 < probability <= 1.0
        assert steps == pytest.approx(14.0, abs=remaining / 100.0)


# -- plans as people see them -----------------------------------------------------------------------------------------


class Straight:
    """A policy that goes straight to its aim; what it sees is the way there."""

    def act(self, views: np.ndarray) -> np.ndarray:
        return np.clip(views, -1.0, 1.0)


def straight_runner(graph: SkillGraph, model: WalkModel | None = None) -> Runner:
    planner = Planner(graph, model or WalkModel(), HORIZON)
    return Runner(graph, planner, Straight(), lambda observation, points, aims: aims - points)  # type: ignore[arg-type]


def plan_from(runner: Runner, point: tuple[float, float], goal: tuple[float, float], state: RunnerState | None = None) -> Plan:
    state = RunnerState.fresh(1, 2, 2) if state is None else state
    return describe(runner, state, np.array(point), np.array(goal))


def known_line() -> SkillGraph:
    graph = line_graph(4)
    for i in range(3):
        tried(graph, i, i + 1, 30)
    return graph


@pytest.mark.parametrize(
    ("goal", "status"), [((12.5, 0.0), "in_graph"), ((12.0, 1.3), "in_initiation_set"), ((12.0, 5.0), "outside")]
)
def test_a_plan_tells_which_of_the_papers_three_cases_holds(goal: tuple[float, float], status: str) -> None:
    assert plan_from(straight_runner(known_line()), (0.0, 0.0), goal).status == status


def test_a_plan_names_options_and_events_in_turn_up_to_the_goal() -> None:
    plan = plan_from(straight_runner(known_line(), hopeless()), (0.0, 0.0), (12.0, 0.0))
    assert plan.path == ("w1", "e1", "w2", "e2", "direct", "goal")  # who can walk to e3 can walk to a goal in it
    assert 0.9 < plan.success_probability <= 1.0
    assert 25.0 < plan.expected_steps < 60.0


def test_a_plan_reads_as_a_sentence() -> None:
    runner = straight_runner(known_line(), hopeless())
    plan = plan_from(runner, (0.0, 0.0), (12.0, 0.0))
    expected = f"about {plan.expected_steps:.0f} steps, success {plan.success_probability:.0%}."
    assert str(plan) == f"The goal lies in an event: go there by way of e1, e2, {expected}"
    assert str(plan._replace(path=("direct", "goal"), status="outside")).startswith(
        "The goal lies where the agent has never been: go there straight on, "
    )
    beside = plan._replace(status="in_initiation_set", expected_steps=np.inf)
    assert str(beside).startswith("The goal lies beside an event: go there by way of e1, e2, no telling when")


def running(option: str, *, began: str, elapsed: float = 0.0, steps: float = 0.0) -> RunnerState:
    fresh = RunnerState.fresh(1, 2, 2)
    ids = [np.array([id], dtype=fresh.option.dtype) for id in (option, began)]
    return fresh._replace(option=ids[0], began=ids[1], elapsed=np.array([elapsed]), steps=np.array([steps]))


def test_a_plan_begins_with_the_option_that_runs() -> None:
    runner = straight_runner(known_line(), hopeless())
    observation = {"observation": np.zeros((1, 2)), "achieved_goal": np.zeros((1, 2))}
    _, state = runner.act(observation, np.array([[12.0, 0.0]]), RunnerState.fresh(1, 2, 2))
    assert state.option.tolist() == ["w1"]
    assert plan_from(runner, (0.0, 0.0), (12.0, 0.0), state).path[0] == "w1"
    assert plan_from(runner, (0.0, 0.0), (12.0, 0.0), running("direct", began="e0")).path == ("direct", "goal")


def test_a_plan_begins_with_the_option_that_runs_where_it_could_not_be_begun() -> None:
    graph = known_line()
    graph.crossed(0, 3, 30)
    runner = straight_runner(graph, hopeless())
    on_the_way = plan_from(runner, (5.0, 0.0), (8.0, 0.0), running("w3", began="e0"))  # from e0 to e3, in e1
    assert on_the_way.path[0] == "w3"
    for began in ("e0", "e2", ""):
        for option in ("w0", "w1", "w2", "w3"):
            plan = plan_from(runner, (5.0, 0.0), (8.0, 0.0), running(option, began=began))
            assert plan.path[0] == option
            assert plan.path[-2:] == ("direct", "goal")
            assert len(set(plan.path)) == len(plan.path)


def test_the_steps_that_an_option_has_run_count_as_part_of_its_own() -> None:
    runner = straight_runner(known_line(), hopeless())
    begun = plan_from(runner, (0.0, 0.0), (12.0, 0.0), running("w1", began="e0", elapsed=950.0))
    for steps in (3.0, 8.0):
        state = running("w1", began="e0", elapsed=950.0 + steps, steps=steps)
        plan = plan_from(runner, (2.0, 0.0), (12.0, 0.0), state)
        assert plan == begun._replace(expected_steps=plan.expected_steps)
        assert plan.expected_steps == pytest.approx(begun.expected_steps - steps)
    late = plan_from(runner, (2.0, 0.0), (12.0, 0.0), running("w1", began="e0", elapsed=980.0, steps=8.0))
    assert late.success_probability < begun.success_probability


def test_time_that_has_passed_makes_success_less_likely() -> None:
    runner = straight_runner(known_line(), hopeless())
    plans = [
        plan_from(runner, (0.0, 0.0), (12.0, 0.0), running("", began="", elapsed=elapsed))
        for elapsed in (0.0, 900.0, 960.0, 995.0, 999.0, 1_000.0, 1_100.0)
    ]
    probabilities = [plan.success_probability for plan in plans]
    assert probabilities == sorted(probabilities, reverse=True)
    assert probabilities[0] > probabilities[2] + 0.02
    assert probabilities[-1] == LEAST  # nothing is impossible
    assert all(0.0 <= plan.expected_steps < np.inf for plan in plans)
