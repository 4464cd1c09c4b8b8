"""What must hold of every skill graph, after any history of runs, refits and triggers."""

import copy
import math
from collections.abc import Iterable
from typing import Any

import networkx as nx
import numpy as np
import pytest
from builders import PAPER_GRAPH, World, event, make_option, profile, put_initiation
from hypothesis import given
from hypothesis import strategies as st

from sb3_skillgraph.graph import SkillGraph
from sb3_skillgraph.options.option import Option

N_EVENTS = 4
MODES: dict[str, dict[str, Any]] = {
    "paper": PAPER_GRAPH,
    "strict": {"containment": 1.0, "evidence_edges": False},
    "strict with evidence": {"containment": 1.0, "evidence_edges": True},
    "lenient": {"containment": 0.9, "evidence_edges": False},
    "default": {},
}
every_mode = pytest.mark.parametrize("mode", MODES)

# -- the rules, written out once more ---------------------------------------------------------------------------------


def share_inside(option: Option, points: list[np.ndarray]) -> float:
    return float(option.initiation.optimistic(np.stack(points)).mean())


def plain_rate(option: Option, prior: tuple[float, float]) -> float:
    n = len(option.record) + prior[0] + prior[1]
    return (sum(option.record) + prior[0]) / n if n else 0.0


def option_event_rate(graph: SkillGraph, option: Option, id: str) -> float:
    """The success rate an edge from an option to an event may have; 0 where there must be none."""
    rate = plain_rate(option, graph.rate_prior)
    if option.target == id:
        return rate
    share = float(graph.events[id].contains(np.stack(option.effects)).mean()) if option.effects else 0.0
    return rate * share if share >= graph.containment else 0.0


def option_option_rate(graph: SkillGraph, first: Option, second: Option) -> float:
    rate = plain_rate(first, graph.rate_prior)
    if first.target == second.id:
        return rate
    share = share_inside(second, list(first.effects)) if first.effects else 0.0
    return rate * share if share >= graph.containment and first is not second else 0.0


def event_option_rate(graph: SkillGraph, id: str, option: Option) -> float:
    share = share_inside(option, list(graph.triggers[id]))
    if option.target == id:
        return 0.0
    return share if share >= graph.containment else 0.0


def allowed_rate(graph: SkillGraph, source: str, target: str) -> float:
    if source in graph.events:
        return event_option_rate(graph, source, graph.options[target]) if target in graph.options else 0.0
    option = graph.options[source]
    if target in graph.events:
        return option_event_rate(graph, option, target)
    return option_option_rate(graph, option, graph.options[target])


def check_edges(graph: SkillGraph) -> None:
    """Every edge exists by a test in force now, and carries the rate and the weight that follow from it."""
    assert set(graph.nx) == graph.events.keys() | graph.options.keys()
    for source, target, edge in graph.nx.edges(data=True):
        expected = allowed_rate(graph, source, target)
        assert expected > 0, f"{source} -> {target} exists without reason: {edge}"
        assert math.isclose(edge["success_rate"], expected), (source, target)
        assert edge["success_rate"] >= graph.min_success_rate
        assert np.isfinite(edge["weight"])
        assert edge["weight"] >= 0
        failures = 1.0 / edge["success_rate"] - 1.0  # before a success, on average
        assert edge["weight"] == (0.0 if source in graph.events else 1.0 + graph.failure_cost * failures)


def check_regions(graph: SkillGraph, options: Iterable[Option]) -> None:
    """An option's set counts a whole event while runs begun there mostly succeed; the bank answers as the sets do."""
    for option in options:
        proven = {
            event
            for (event, id), outcomes in graph.evidence.items()
            if id == option.id and (sum(outcomes) + 1) / (len(outcomes) + 2) >= 0.5
        }
        assert set(option.initiation.regions) == (proven if graph.evidence_edges else set())
        for id, points in option.initiation.regions.items():
            np.testing.assert_array_equal(points, graph.events[id].outline())
    points = np.stack([np.linspace(-3.0, 13.0, 9), np.zeros(9)], axis=1)
    indices, inside = graph.option_bank.startable(points)
    by_id = {graph.option_bank.options[i].id: column for i, column in zip(indices, inside.T, strict=True)}
    for id, option in graph.options.items():
        np.testing.assert_array_equal(by_id.get(id, np.zeros(9, dtype=bool)), option.initiation.optimistic(points), err_msg=id)


def check_paths(graph: SkillGraph) -> None:
    """Every path returned is one of the graph, the cheapest, and its numbers are those of its edges."""
    backwards = graph.nx.reverse(copy=True)
    for target in graph.nx:
        costs = nx.single_source_dijkstra_path_length(backwards, target, weight="weight")
        for source in graph.nx:
            path = graph.shortest_path([source], target)
            assert (path is not None) == (source in costs)
            if path is None:
                continue
            assert (path.vertices[0], path.vertices[-1]) == (source, target)
            edges = [graph.nx.edges[edge] for edge in zip(path.vertices[:-1], path.vertices[1:], strict=True)]
            assert math.isclose(path.cost, sum(edge["weight"] for edge in edges))
            assert math.isclose(path.cost, costs[source])
            assert math.isclose(path.success_probability, math.prod(edge["success_rate"] for edge in edges))
    for sources in (list(graph.nx)[:1], list(graph.options)[:3], []):
        tree = graph.ways_from(sources)
        for target in graph.nx:
            path = graph.shortest_path(sources, target)
            assert (target in tree) == (path is not None)
            if path is not None:
                assert math.isclose(tree.cost(target), path.cost)
                assert tree.path(target)[0] in sources
                assert tree.path(target)[-1] == target
        back = [graph.ways_to(target) for target in sources]
        for source in graph.nx:
            for target, tree_to in zip(sources, back, strict=True):
                path = graph.shortest_path([source], target)
                assert (source in tree_to) == (path is not None)
                assert path is None or math.isclose(tree_to.cost(source), path.cost)


def check_starts(world: World) -> None:
    """No option is planned, or chosen, from outside its initiation set."""
    graph = world.graph
    for x in np.linspace(-3.0, 11.0, 8):
        point = np.array([x, 0.0])
        startable = [id for id, option in graph.options.items() if option.initiation.optimistic(point[None])[0]]
        assert graph.startable(point) == startable
        for target in graph.events:
            path = world.planner.path_to(point, target)
            useful = [id for id in startable if not graph.options[id].terminates(point)]
            assert graph.useful(point) == useful
            assert (path is not None) == any(nx.has_path(graph.nx, id, target) for id in useful)
            assert path is None or path.vertices[0] in useful
            for avoid in ([*graph.options][:1], useful[:1], [*graph.options][1:3], useful):
                check_detour(world, point, target, avoid)


def check_detour(world: World, point: np.ndarray, target: str, avoid: list[str]) -> None:
    """No plan runs through what has failed lately, unless nothing else leads there."""
    graph = world.graph
    detour, path = world.planner.path_to(point, target, avoid), world.planner.path_to(point, target)
    remaining = graph.nx.subgraph(set(graph.nx) - set(avoid))
    if any(nx.has_path(remaining, id, target) for id in graph.useful(point) if id not in avoid):
        assert detour is not None
        assert path is not None
        assert not set(detour.vertices) & set(avoid)
        assert nx.is_path(graph.nx, detour.vertices)
        assert detour.vertices[0] in graph.useful(point)
        assert detour.cost >= path.cost or math.isclose(detour.cost, path.cost)
        assert math.isclose(detour.cost, nx.path_weight(graph.nx, detour.vertices, "weight"))
    else:
        assert detour == path


# -- histories on a line, with discs for initiation sets --------------------------------------------------------------

index = st.integers(0, 7)
place = st.sampled_from([0.0, 0.8, 1.8, 2.5, 4.0, 5.0, 7.5, 9.0])
width = st.sampled_from([0.6, 1.5, 3.0, 20.0])
operations = st.lists(
    st.one_of(
        st.tuples(st.just("option"), index, place, width),
        st.tuples(st.just("chained"), index, place, width),
        st.tuples(st.just("success"), index, place, st.sampled_from([-0.8, 0.0, 0.8])),
        st.tuples(st.just("failure"), index, place, st.just(0.0)),
        st.tuples(st.just("refit"), index, place, width),
        st.tuples(st.just("trigger"), index, st.sampled_from([-0.9, 0.0, 0.9]), st.just(0.0)),
        st.tuples(st.just("remove"), index, st.just(0), st.just(0.0)),
    ),
    min_size=12,
    max_size=40,
)


class History:
    """Applies operations to a world; options and events are picked by number, wrapped around."""

    def __init__(self, mode: str) -> None:
        self.world = World(**MODES[mode])
        self.graph = self.world.graph
        self.n_made = 0
        for k in range(N_EVENTS):
            self.world.add_event(2.5 * k, 0.0)
        for target, x in ((1, 0.0), (2, 2.5), (0, 2.5)):
            self.apply("option", target, x, 1.5)

    def _option(self, number: int) -> Option | None:
        options = list(self.graph.options.values())
        return options[number % len(options)] if options else None

    def apply(self, kind: str, number: int, x: float, extra: float) -> None:
        if kind == "trigger":
            target = self.graph.events[f"e{number % N_EVENTS}"]
            self.graph.triggered(target, target.center + np.array([x, 0.0]))
            return
        if kind == "option":
            target = self.graph.events[f"e{number % N_EVENTS}"]
            self._add(target.id, target, x, extra)
            return
        option = self._option(number)
        if option is None:
            return
        if kind == "chained":
            self._add(option.id, option, x, extra)
        elif kind == "refit":
            put_initiation(option.initiation, (x, 0.0), extra)
            self.graph.refresh(option, refitted=True)
        elif kind == "remove":
            if not any(other.target == option.id for other in self.graph.options.values()):
                self.graph.remove_options([option.id])
        else:
            self._run(option, np.array([x, 0.0]), kind == "success", extra)

    def _add(self, target: str, termination: Any, x: float, radius: float) -> None:
        self.n_made += 1
        option = make_option(f"o{self.n_made}", target, termination, start=((x, 0.0), radius))
        self.world.chaining.options[option.id] = option
        self.graph.add_option(option)

    def _run(self, option: Option, start: np.ndarray, success: bool, offset: float) -> None:
        if success:
            termination = option.termination
            center = termination.initiation.core if isinstance(termination, Option) else option.subgoal
            assert center is not None
            end = center + np.array([offset, 0.0])
            if not option.terminates(end):
                end = center
            option.succeeded(np.stack([start, start]), end)
        else:
            option.failed(start)
        for one in self.graph.events.values():
            if one.id != option.target and one.contains(start[None])[0]:
                self.graph.ran_from(one, option, success)
        self.graph.refresh(option, refitted=False)


@every_mode
@given(operations)
@profile(25, shrink=False)
def test_an_edge_exists_only_while_its_test_holds(mode: str, sequence: list[tuple[str, int, float, float]]) -> None:
    history = History(mode)
    for operation in sequence:
        history.apply(*operation)
        check_edges(history.graph)
        check_regions(history.graph, history.graph.options.values())


@every_mode
@given(operations)
@profile(6, shrink=False)
def test_paths_are_paths_of_the_graph_that_can_be_begun(mode: str, sequence: list[tuple[str, int, float, float]]) -> None:
    history = History(mode)
    for k, operation in enumerate(sequence):
        history.apply(*operation)
        history.graph.shortest_path(["o1"], "e0")  # what is cached now must not be used later
        if k == 9:
            check_paths(history.graph)
    check_paths(history.graph)
    check_starts(history.world)


@every_mode
@given(operations, operations)
@profile(4, shrink=False)
def test_a_restored_graph_is_the_same_graph(
    mode: str, before: list[tuple[str, int, float, float]], after: list[tuple[str, int, float, float]]
) -> None:
    history, twin = History(mode), History(mode)
    for operation in before:
        history.apply(*operation)
        twin.apply(*operation)
    graph = twin.graph
    restored = SkillGraph(
        2, graph.containment, graph.rate_prior, graph.evidence_edges, graph.min_success_rate, graph.failure_cost
    )
    restored.set_state(copy.deepcopy(graph.get_state()), graph.options)
    twin.world.graph = twin.graph = twin.world.planner.graph = restored
    for operation in [None, *after]:
        if operation is not None:
            history.apply(*operation)
            twin.apply(*operation)
        one, other = history.graph, twin.graph
        assert list(one.nx) == list(other.nx)
        assert {v: dict(one.nx.succ[v]) for v in one.nx} == {v: dict(other.nx.succ[v]) for v in other.nx}
        for x in (-1.0, 2.0, 5.0):
            for target in one.events:
                point = np.array([x, 0.0])
                assert history.world.planner.path_to(point, target) == twin.world.planner.path_to(point, target)


# -- histories of chains, with real initiation sets -------------------------------------------------------------------

runs = st.lists(st.tuples(index, st.integers(-2, 22), st.booleans(), st.booleans()), min_size=10, max_size=30)


@every_mode
@given(runs)
@profile(5, shrink=False)
def test_chains_keep_the_graph_in_order(mode: str, sequence: list[tuple[int, int, bool, bool]]) -> None:
    world = World(**MODES[mode])
    chaining, graph = world.chaining, world.graph
    for x in (0.0, 5.0, 10.0):
        world.add_event(x, 0.0)
    for source, target in (("e0", "e1"), ("e1", "e2"), ("e1", "e0")):
        chaining.open_chain(graph.events[source], graph.events[target])
    for number, x, success, own in sequence:
        options = list(chaining.options.values())
        option = options[number % len(options)]
        start = np.array([0.5 * x, 0.0])
        if success:
            end = option.subgoal
            chaining.learn_success(option, np.linspace(start, end, 12), end, own=own)
            touched = graph.events.get(option.target or "")
            if touched is not None:
                graph.triggered(touched, end)
        else:
            chaining.learn_failure(option, start)
        check_edges(graph)
        check_regions(graph, options)
        assert set(graph.options) == {id for id, o in chaining.options.items() if o.mature} == set(world.matured)
        for chain in chaining.chains.values():
            ways = [chaining.options[id] for id in chain.options]
            assert all(o.mature for o in ways[:-1])
            assert [o.target for o in ways] == [chain.target, *chain.options[:-1]]
            assert not (chain.complete and not ways[0].mature)
            startable = [way for way in ways if graph.nx.has_edge(chain.source, way.id)]
            assert not (chain.complete and not startable) or chain is not chaining.chain_of[option.id]
    check_paths(graph)
    check_starts(world)


def test_events_do_not_lead_to_events() -> None:
    graph = SkillGraph(2)
    for k in range(3):
        graph.add_event(event(k, 0.5 * k, 0.0))
    assert graph.nx.number_of_edges() == 0
