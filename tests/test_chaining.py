"""Deep skill chaining on a line: the agent stands at x, an option carries it to where it aims."""

import copy

import numpy as np
import pytest
from builders import PAPER_GRAPH, World

from sb3_skillgraph.chaining import DeepSkillChaining, SkillChain
from sb3_skillgraph.options.option import RECORD_LENGTH, Option


class Line(World):
    """Source e0 at x = 0, target e1 at x = 10, both of radius 1."""

    def __init__(self, **graph_kwargs: object) -> None:
        super().__init__(**graph_kwargs)
        self.source, self.target = self.add_event(0.0, 0.0), self.add_event(10.0, 0.0)
        self.chain = self.chaining.open_chain(self.source, self.target)

    def option(self, k: int) -> Option:
        return self.chaining.options[self.chain.options[k]]

    def succeed(self, option: Option, start: float, times: int = 1, *, own: bool = True) -> None:
        for _ in range(times):
            end = option.subgoal.copy()
            assert option.terminates(end)
            path = np.linspace([start, 0.0], end, 15)[:-1]
            self.chaining.learn_success(option, path, end, own=own)

    def fail(self, option: Option, start: float, times: int = 1) -> None:
        for _ in range(times):
            self.chaining.learn_failure(option, np.array([start, 0.0]))

    def admissible(self, x: float) -> str:
        return self.chaining.admissible(self.chain, np.array([x, 0.0])).id


@pytest.fixture
def line() -> Line:
    return Line()


def test_a_chain_begins_with_a_gestating_root_that_ends_in_the_target(line: Line) -> None:
    root = line.option(0)
    assert (root.id, root.target, root.mature) == ("o1", "e1", False)
    assert root.termination is line.target
    assert root.subgoal.tolist() == [10.0, 0.0]
    assert root.id not in line.graph.nx
    assert line.chaining.open_chains() == [line.chain]


@pytest.mark.parametrize("own", [True, False])
def test_the_root_matures_after_the_gestation_period(line: Line, own: bool) -> None:
    root = line.option(0)
    line.fail(root, 0.0, 2)
    line.succeed(root, 6.0, 2, own=own)
    assert not root.mature
    assert line.matured == []
    line.succeed(root, 6.0, own=own)
    assert root.mature
    assert line.matured == ["o1"]
    assert "o1" in line.graph.nx
    line.succeed(root, 6.0, 3)
    assert line.matured == ["o1"]  # once


def test_a_chain_is_complete_when_the_source_is_inside(line: Line) -> None:
    line.succeed(line.option(0), 0.0, 3)
    assert line.graph.nx.has_edge("e0", "o1")
    assert line.chain.complete
    assert line.chain.options == ["o1"]
    assert line.chaining.open_chains() == []
    path = line.planner.path_to(np.zeros(2), "e1")
    assert path is not None
    assert path.vertices == ("o1", "e1")


def test_a_child_leads_to_the_parents_pessimistic_set_when_the_source_is_outside(line: Line) -> None:
    root = line.option(0)
    line.succeed(root, 6.0, 3)
    assert not line.chain.complete
    assert line.chain.options == ["o1", "o2"]
    child = line.option(1)
    assert child.target == "o1"
    assert child.termination is root
    assert not child.mature
    points = np.stack([np.linspace(-5, 15, 81), np.zeros(81)], axis=1)
    assert [child.terminates(point) for point in points] == root.initiation.pessimistic(points).tolist()
    np.testing.assert_array_equal(child.subgoal, root.initiation.core)
    assert line.chaining.chain_of["o2"] is line.chain


def test_a_chain_grows_back_until_it_covers_the_source(line: Line) -> None:
    line.succeed(line.option(0), 7.0, 3)
    line.succeed(line.option(1), 4.0, 3)
    assert line.chain.options == ["o1", "o2", "o3"]
    assert not line.chain.complete
    line.succeed(line.option(2), 0.0, 3)
    assert line.chain.complete
    assert line.chain.options == ["o1", "o2", "o3"]
    path = line.planner.path_to(np.zeros(2), "e1")
    assert path is not None
    assert path.vertices == ("o3", "o2", "o1", "e1")
    assert line.graph.joined_pairs() == 0.5


def test_one_child_at_a_time(line: Line) -> None:
    line.succeed(line.option(0), 7.0, 10)
    assert line.chain.options == ["o1", "o2"]


def test_an_option_that_fails_from_the_source_gets_a_child(line: Line) -> None:
    line.chaining.max_failures = None
    root = line.option(0)
    line.succeed(root, 0.0)
    line.succeed(root, 7.0, 2)
    n_options = len(line.chain.options)
    line.fail(root, 0.0, 12)
    assert not line.graph.nx.has_edge("e0", "o1")
    assert not line.chain.complete
    assert len(line.chain.options) == 2 >= n_options


def test_strictly_a_chain_is_complete_only_when_all_trigger_points_are_inside() -> None:
    line = Line(**PAPER_GRAPH)
    for x in (-0.9, 0.9):
        line.graph.triggered(line.source, np.array([x, 0.0]))
    line.succeed(line.option(0), 1.1, 3)
    assert not line.chain.complete
    assert len(line.chain.options) == 2
    line.succeed(line.option(1), -1.0, 3)
    assert line.chain.complete


def test_strictly_a_chain_does_not_wait_for_ever_beside_its_source() -> None:
    """A.3: a chain is complete when an option's set contains the source; until then it goes on growing.

    The root is run from one side of the source only, and always succeeds; the source has been triggered at its other
    side, where the root cannot start.
    """
    line = Line(**PAPER_GRAPH)
    for _ in range(5):
        line.graph.triggered(line.source, np.array([-0.95, 0.0]))
    line.succeed(line.option(0), 0.95, 20)
    assert not line.option(0).initiation.optimistic(np.array([[-0.95, 0.0]]))[0]
    assert line.chain.complete or len(line.chain.options) == 2


def test_admissible_is_the_earliest_option_that_can_start(line: Line) -> None:
    assert line.admissible(0.0) == line.admissible(6.0) == "o1"  # gestating: anywhere
    line.succeed(line.option(0), 7.0, 3)
    assert line.admissible(8.0) == "o1"
    assert line.admissible(0.0) == "o2"
    line.succeed(line.option(1), 3.5, 3)
    assert line.admissible(8.5) == "o1"
    assert line.admissible(4.0) == "o2"
    assert line.admissible(0.0) == "o3"
    line.succeed(line.option(2), 0.0, 3)
    assert line.admissible(0.0) == "o3"
    assert line.admissible(-9.0) == "o3"  # none can start: the last


def test_admissible_is_none_that_has_nothing_to_do(line: Line) -> None:
    line.succeed(line.option(0), 7.0, 3)
    root, child = line.option(0), line.option(1)
    inside_parent = root.subgoal if root.initiation.core is None else root.initiation.core
    assert child.terminates(inside_parent)
    assert line.chaining.admissible(line.chain, inside_parent).id == "o1"


def test_hopeless_chains_are_dropped_and_taken_up_again(line: Line) -> None:
    root = line.option(0)
    line.fail(root, 0.0, 3)
    line.succeed(root, 9.5)
    assert line.chain.n_failures == 0  # a success starts the count anew
    line.fail(root, 0.0, 3)
    assert line.chain.open
    line.fail(root, 0.0)
    assert line.chain.dropped
    assert line.chaining.open_chains() == []
    again = line.chaining.open_chain(line.source, line.target)
    assert again is line.chain
    assert again.open
    assert (again.n_failures, again.options) == (0, ["o1"])


def test_without_a_limit_no_chain_is_dropped(line: Line) -> None:
    line.chaining.max_failures = None
    line.fail(line.option(0), 0.0, 50)
    assert line.chain.open


def test_a_complete_chain_is_not_dropped(line: Line) -> None:
    line.succeed(line.option(0), 0.0, 20)
    line.fail(line.option(0), 5.0, 3)
    assert line.chain.complete
    assert not line.chain.dropped


def test_the_backward_chain_leads_from_the_target_to_the_source(line: Line) -> None:
    back = line.chaining.open_chain(line.target, line.source)
    assert back.id == "e1>e0"
    root = line.chaining.options[back.options[0]]
    assert root.target == "e0"
    assert root.termination is line.source
    line.succeed(root, 10.0, 3)
    assert back.complete
    assert not line.chain.complete
    line.succeed(line.option(0), 0.0, 3)
    assert line.graph.joined_pairs() == 1.0


def test_a_complete_chain_whose_edge_breaks_is_open_again(line: Line) -> None:
    line.chaining.max_failures = None
    root = line.option(0)
    line.succeed(root, 0.0, 3)
    assert line.chain.complete
    line.succeed(root, 6.0, 4)
    line.fail(root, 0.0, 20)
    assert not line.graph.nx.has_edge("e0", "o1")
    assert not line.chain.complete


@pytest.mark.parametrize("practice_runs", [1, 2, 5])
def test_a_chain_stays_open_until_so_many_runs_of_its_own_have_succeeded(line: Line, practice_runs: int) -> None:
    line.chaining.practice_runs = practice_runs
    line.chaining.gestation_period = 1
    root = line.option(0)
    line.succeed(root, 0.0, 9, own=False)
    assert root.mature
    assert line.planner.path_to(np.zeros(2), "e1") is not None  # the graph has its edge meanwhile
    for _ in range(practice_runs):
        assert line.chain.open
        line.fail(root, 5.0)
        assert line.chain.open
        line.succeed(root, 0.0)
    assert line.chain.complete
    assert line.chaining.open_chains() == []


def test_practice_that_is_long_ago_does_not_count(line: Line) -> None:
    """Successes among the recent runs, not ever."""
    line.chaining.max_failures, line.chaining.practice_runs = None, 2
    root = line.option(0)
    line.succeed(root, 0.0, 3)
    assert line.chain.complete
    line.fail(root, 5.0, RECORD_LENGTH - 1)
    assert line.graph.nx.has_edge("e0", "o1")
    assert line.chain.open


def test_an_option_that_cannot_start_at_the_source_completes_nothing(line: Line) -> None:
    line.chaining.practice_runs = 2
    line.succeed(line.option(0), 6.0, 12)
    assert line.chain.open
    line.succeed(line.option(1), 0.0, 3, own=False)  # the child matures by what others did
    assert line.graph.nx.has_edge("e0", "o2")
    line.succeed(line.option(0), 6.0, 3)
    assert line.chain.open  # the practice of the one is none of the other
    line.succeed(line.option(1), 0.0, 2)
    assert line.chain.complete


def test_a_success_in_a_dropped_chain_counts_but_does_not_open_it(line: Line) -> None:
    root = line.option(0)
    line.fail(root, 5.0, 4)
    assert line.chain.dropped
    line.succeed(root, 0.0, 2)
    assert not line.chain.open
    line.succeed(root, 0.0)
    assert line.chain.complete
    assert line.chain.dropped
    assert line.planner.path_to(np.zeros(2), "e1") is not None


def test_a_run_from_the_source_puts_all_of_it_into_the_set(line: Line) -> None:
    root = line.option(0)
    line.succeed(root, 0.9, 3)
    assert root.initiation.optimistic(line.source.outline()).all()
    assert line.chain.complete
    assert line.admissible(-0.9) == "o1"


def test_a_chain_is_practised_until_its_own_runs_have_succeeded(line: Line) -> None:
    line.chaining.practice_runs = 2
    root = line.option(0)
    line.succeed(root, 0.0, 3, own=False)  # others have shown the way
    assert root.mature
    assert line.graph.nx.has_edge("e0", "o1")
    assert line.chain.open
    line.succeed(root, 0.0)
    line.fail(root, 0.0)
    assert line.chain.open
    line.succeed(root, 0.0)
    assert line.chain.complete
    assert line.chain.options == ["o1"]  # it could be started from the source all along: no child


def test_unsettled_are_the_events_whose_joining_chain_is_open(line: Line) -> None:
    assert line.chaining.unsettled() == set()
    third = line.add_event(20.0, 0.0)
    joining = line.chaining.open_chain(line.target, third, joins=True)
    line.chaining.open_chain(third, line.target)
    assert line.chaining.unsettled() == {"e2"}
    line.succeed(line.chaining.options[joining.options[0]], 10.0, 3)
    assert joining.complete
    assert line.chaining.unsettled() == set()


def test_runs_that_begin_in_an_event_are_its_evidence(line: Line) -> None:
    root = line.option(0)
    line.succeed(root, 0.5)
    line.fail(root, -0.5)
    line.fail(root, 5.0)
    line.fail(root, 10.0)  # in the event that the option leads to
    assert {key: list(outcomes) for key, outcomes in line.graph.evidence.items()} == {("e0", "o1"): [True, False]}


def test_state_round_trip(line: Line) -> None:
    line.succeed(line.option(0), 7.0, 3)
    line.chaining.open_chain(line.target, line.source)
    line.fail(line.option(1), 0.0, 2)
    restored = DeepSkillChaining(line.graph, line.chaining.make_option, print, 3, 0, 4)
    restored.set_state(copy.deepcopy(line.chaining.get_state()), line.chaining.options)
    assert restored.chains == line.chaining.chains
    assert list(restored.options) == ["o1", "o2", "o3"]
    assert restored.chain_of["o2"] is restored.chains["e0>e1"]
    assert isinstance(restored.chains["e1>e0"], SkillChain)
    for x in (0.0, 8.0):
        point = np.array([x, 0.0])
        assert restored.admissible(restored.chains["e0>e1"], point).id == line.admissible(x)
