"""The edges of a skill graph and the records of the runs on them, as arrays that a planner can read at once."""

import numpy as np

#: What stands in place of an event's index where there is none. Of an array with one more entry than there are events it
#: is the last entry.
NOWHERE = -1
#: Different events in which failed runs of one edge have landed that are told apart.
MAX_LANDINGS = 4

_INDICES = ("source", "target")
#: What runs write into a record: it ages.
RECORD = ("successes", "success_steps", "failures", "failure_steps")
#: All columns that hold numbers.
NUMBERS = ("forward", "backward", "crossing_steps", *RECORD, "updated")


class _Column:
    """What is known of all edges: a view of an array that grows."""

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    def __get__(self, edges: "Edges", owner: type) -> np.ndarray:
        return edges._arrays[self.name][: edges.size]


class Edges:
    """Which options can be begun in which events, and how they did: one row for each pair.

    The columns are views of arrays that grow: what is written into them is kept, until :meth:`add` or :meth:`keep`.
    """

    #: Index of the event that the option is begun in, shape ``(n_edges,)`` like all that follow.
    source = _Column()
    #: Index of the event that it leads to; the option is the walk to it.
    target = _Column()
    #: How often trajectories went from source to target in few steps.
    forward = _Column()
    #: How often they went the other way.
    backward = _Column()
    #: Environment steps they took from source to target in the mean; backwards, where none went forward.
    crossing_steps = _Column()
    #: Runs that succeeded, weighted by age.
    successes = _Column()
    #: Environment steps of those, summed with the same weights.
    success_steps = _Column()
    #: Runs that failed, weighted by age.
    failures = _Column()
    #: Environment steps of those, summed with the same weights.
    failure_steps = _Column()
    #: The time, in updates of the walker, for which the weights hold.
    updated = _Column()
    #: Events in which failed runs landed, shape ``(n_edges, MAX_LANDINGS)``.
    landing = _Column()
    #: The weight of those runs, same shape; 0 where there is none.
    landing_weight = _Column()

    def __init__(self) -> None:
        self.size = 0
        self._arrays: dict[str, np.ndarray] = {
            **{name: np.zeros(64, dtype=np.int64) for name in _INDICES},
            "landing": np.full((64, MAX_LANDINGS), NOWHERE, dtype=np.int64),
            "landing_weight": np.zeros((64, MAX_LANDINGS)),
            **{name: np.zeros(64) for name in NUMBERS},
        }
        self._rows: dict[tuple[int, int], int] = {}
        self.let_go: set[tuple[int, int]] = set()  # pairs that a trajectory went between, of which a row was not kept

    def find(self, source: int, target: int) -> int | None:
        """Return the row of a pair of events; None if there is no such edge."""
        return self._rows.get((source, target))

    def add(self, source: int, target: int, now: float) -> int:
        """Return the row of a pair of events, which is made if there is none.

        :param source: index of the event that the option is begun in
        :param target: index of the event that it leads to
        :param now: the time, in updates of the walker
        """
        row = self._rows.get((source, target))
        if row is not None:
            return row
        row = self.size
        if row == len(self._arrays["source"]):
            for name, array in self._arrays.items():
                self._arrays[name] = np.concatenate([array, np.zeros((max(row, 64), *array.shape[1:]), array.dtype)])
        for array in self._arrays.values():
            array[row] = 0
        self._arrays["landing"][row] = NOWHERE
        self._arrays["source"][row], self._arrays["target"][row], self._arrays["updated"][row] = source, target, now
        self._rows[source, target] = row
        self.size += 1
        return row

    def keep(self, rows: np.ndarray) -> None:
        """Let go of all other rows; that somebody went there is still known.

        :param rows: row numbers, ascending
        """
        gone = np.setdiff1d(np.flatnonzero(self.forward > 0), rows)
        self.let_go.update(zip(self.source[gone].tolist(), self.target[gone].tolist(), strict=True))
        for array in self._arrays.values():
            array[: len(rows)] = array[rows]
        self.size = len(rows)
        self._rows = self._by_pair()

    def _by_pair(self) -> dict[tuple[int, int], int]:
        pairs = zip(self.source.tolist(), self.target.tolist(), strict=True)
        return {pair: row for row, pair in enumerate(pairs)}

    def get_state(self) -> dict[str, np.ndarray]:
        """Return all columns, and the pairs that were let go."""
        let_go = np.array(sorted(self.let_go), dtype=np.int64).reshape(-1, 2)
        return {**{name: array[: self.size].copy() for name, array in self._arrays.items()}, "let_go": let_go}

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        """Restore what :meth:`get_state` returned."""
        self.size = len(state["source"])
        self._arrays = {name: np.array(state[name]) for name in self._arrays}
        self._rows = self._by_pair()
        self.let_go = {(source, target) for source, target in state["let_go"].tolist()}


def land(landings: np.ndarray, weights: np.ndarray, landing: int, weight: float) -> None:
    """Add to the weight of a landing, in place; a new one takes the place of the lightest.

    :param landings: events in which runs landed, shape ``(MAX_LANDINGS,)``
    :param weights: their weights, same shape
    :param landing: the event, ``NOWHERE`` for none
    :param weight: to add
    """
    known = np.flatnonzero((landings == landing) & (weights > 0.0))
    slot = int(known[0]) if len(known) else int(weights.argmin())
    if not len(known):
        landings[slot], weights[slot] = landing, 0.0
    weights[slot] += weight
