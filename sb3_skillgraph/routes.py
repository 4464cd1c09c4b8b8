"""Cheapest ways over a graph that changes an edge at a time; SciPy's Dijkstra finds them."""

from collections.abc import Collection, Iterable, Sequence

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra


class Tree:
    """The cheapest ways from any of some vertices to all others, or from all others to one.

    :param numbers: number of every vertex
    :param ids: the vertices by number
    :param costs: cost of the way, ``inf`` where there is none, by number
    :param next: the vertex before on the way from the sources (after, on the way to the target), by number
    :param towards: whether the ways lead to the root rather than from it
    """

    def __init__(
        self, numbers: dict[str, int], ids: list[str], costs: np.ndarray, next: np.ndarray, towards: bool = False
    ) -> None:
        self._numbers = numbers
        self._ids = ids
        self._costs = costs
        self._next = next
        self._towards = towards

    def __contains__(self, vertex: str) -> bool:
        return self.cost(vertex) < np.inf

    def cost(self, vertex: str) -> float:
        """Return the cost of the cheapest way, ``inf`` if there is none."""
        number = self._numbers.get(vertex)
        return float("inf") if number is None else float(self._costs[number])

    def path(self, vertex: str) -> list[str]:
        """Return the vertices on the cheapest way, both ends included.

        :param vertex: one that there is a way to
        """
        path, number = [], self._numbers[vertex]
        while number >= 0:
            path.append(self._ids[number])
            number = int(self._next[number])
        return path if self._towards else path[::-1]

    def on_the_way(self, vertices: Iterable[str]) -> set[str]:
        """Return all vertices on the cheapest ways to (or from) some that there are ways to, these included."""
        seen: set[int] = set()
        for vertex in vertices:
            number = self._numbers[vertex] if vertex in self else -1
            while number >= 0 and number not in seen:
                seen.add(number)
                number = int(self._next[number])
        return {self._ids[number] for number in seen}


class Routes:
    """The weights of a directed graph as SciPy wants them, kept up to date edge by edge."""

    def __init__(self) -> None:
        self._numbers: dict[str, int] = {}
        self._ids: list[str] = []
        self._slots: dict[tuple[int, int], int] = {}
        self._ends = np.zeros((2, 64), dtype=np.int32)
        self._weights = np.zeros(64)
        self._matrix: csr_array | None = None

    def add_vertex(self, id: str) -> None:
        """Add a vertex without edges."""
        self._numbers[id] = len(self._ids)
        self._ids.append(id)
        self._matrix = None

    def set_edge(self, source: str, target: str, weight: float) -> None:
        """Add an edge, or change its weight.

        :param source: where it begins
        :param target: where it ends
        :param weight: finite, not negative
        """
        ends = self._numbers[source], self._numbers[target]
        slot = self._slots.setdefault(ends, len(self._slots))
        if slot == len(self._weights):
            self._ends = np.concatenate([self._ends, np.zeros_like(self._ends)], axis=1)
            self._weights = np.concatenate([self._weights, np.zeros_like(self._weights)])
        self._ends[:, slot] = ends
        self._weights[slot] = weight
        self._matrix = None

    def remove_edge(self, source: str, target: str) -> None:
        """Remove an edge that exists."""
        slot = self._slots.pop((self._numbers[source], self._numbers[target]))
        last = len(self._slots)
        if slot != last:  # the last edge moves into the gap
            self._ends[:, slot], self._weights[slot] = self._ends[:, last], self._weights[last]
            self._slots[int(self._ends[0, slot]), int(self._ends[1, slot])] = slot
        self._matrix = None

    def ways_from(self, sources: Sequence[str], avoid: Collection[str] = ()) -> Tree:
        """Find the cheapest ways from any of some vertices to all others.

        :param sources: vertices
        :param avoid: vertices that no way may lead through
        """
        matrix = self._csr()
        roots = [self._numbers[id] for id in dict.fromkeys(sources) if id in self._numbers and id not in avoid]
        if not roots:
            return Tree(self._numbers, self._ids, np.full(len(self._ids), np.inf), np.full(len(self._ids), -1))
        closed = np.array([self._numbers[id] for id in avoid if id in self._numbers], dtype=np.int32)
        if len(closed):
            # An edge of infinite weight leads nowhere.
            matrix = matrix.copy()
            matrix.data[np.isin(matrix.indices, closed)] = np.inf
        costs, before, _ = dijkstra(matrix, indices=roots, min_only=True, return_predecessors=True)
        return Tree(self._numbers, self._ids, costs, before)

    def ways_to(self, target: str) -> Tree:
        """Find the cheapest ways from all vertices to one.

        :param target: a vertex
        """
        costs, after = dijkstra(self._csr().T.tocsr(), indices=self._numbers[target], return_predecessors=True)
        return Tree(self._numbers, self._ids, costs, after, towards=True)

    def _csr(self) -> csr_array:
        if self._matrix is None:
            n, used = len(self._ids), len(self._slots)
            self._matrix = csr_array((self._weights[:used], self._ends[:, :used]), shape=(n, n))
            # The same graph gives the same ways, in whatever order its edges came.
            self._matrix.sort_indices()
        return self._matrix
