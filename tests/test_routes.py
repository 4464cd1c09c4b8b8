"""SciPy's ways are networkx's ways, however the graph came about."""

import networkx as nx
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from sb3_skillgraph.routes import Routes

VERTICES = st.integers(0, 7)
#: An edge's weight; None removes it.
CHANGE = st.tuples(VERTICES, VERTICES, st.one_of(st.none(), st.just(0.0), st.floats(1.0, 5.0)))


@given(st.lists(CHANGE, max_size=60), st.lists(VERTICES, max_size=3), st.lists(VERTICES, max_size=3))
def test_cheapest_ways(changes: list[tuple[int, int, float | None]], sources: list[int], avoid: list[int]) -> None:
    routes, graph = Routes(), nx.DiGraph()
    for i in range(8):
        routes.add_vertex(f"v{i}")
        graph.add_node(f"v{i}")
    for u, v, weight in changes:
        source, target = f"v{u}", f"v{v}"
        if weight is not None:
            routes.set_edge(source, target, weight)
            graph.add_edge(source, target, weight=weight)
        elif graph.has_edge(source, target):
            routes.remove_edge(source, target)
            graph.remove_edge(source, target)
    closed = {f"v{i}" for i in avoid}
    roots = [f"v{i}" for i in sources if f"v{i}" not in closed]
    open_graph = graph.subgraph(set(graph) - closed)
    expected = nx.multi_source_dijkstra_path_length(open_graph, set(roots)) if roots else {}
    tree = routes.ways_from([f"v{i}" for i in sources], sorted(closed))
    for id in graph:
        assert (id in tree) == (id in expected)
        if id in expected:
            assert np.isclose(tree.cost(id), expected[id])
            path = tree.path(id)
            assert (path[0] in roots, path[-1]) == (True, id)
            assert np.isclose(nx.path_weight(open_graph, path, "weight"), expected[id])
    back, costs = routes.ways_to("v0"), nx.single_source_dijkstra_path_length(graph.reverse(), "v0")
    for id in graph:
        assert (id in back) == (id in costs)
        if id in costs:
            assert np.isclose(back.cost(id), costs[id])
            path = back.path(id)
            assert (path[0], path[-1]) == (id, "v0")
            assert np.isclose(nx.path_weight(graph, path, "weight"), costs[id])


def test_a_vertex_that_nobody_knows() -> None:
    routes = Routes()
    routes.add_vertex("a")
    assert "b" not in routes.ways_from(["a", "b"])
    assert routes.ways_from(["a"], ["b"]).path("a") == ["a"]
