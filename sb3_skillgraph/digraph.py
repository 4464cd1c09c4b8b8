"""The skill graph as networkx has it, to look at: events and options as vertices, numbers and strings only (section 3.1)."""

from typing import TYPE_CHECKING

import numpy as np

from sb3_skillgraph.edges import NOWHERE, RECORD, Edges
from sb3_skillgraph.events import Event

if TYPE_CHECKING:
    import networkx

#: What the picture of an edge shows of its record.
SHOWN = ("forward", "backward", "crossing_steps", *RECORD)


def as_digraph(events: list[Event], walk_ids: list[str], edges: Edges) -> "networkx.DiGraph":
    """Return a graph of events and of the walks to them.

    Edges from an event to a walk carry the record of the walk's runs from there; edges from a walk to an event the share of
    its runs that landed there, wherever they began.

    :param events: all events
    :param walk_ids: ids of the walks to them, in their order
    :param edges: from events to walks
    """
    import networkx  # when it is used: it takes a while to import

    graph = networkx.DiGraph()
    for event, walk in zip(events, walk_ids, strict=True):
        graph.add_node(event.id, **event.as_vertex())
        graph.add_node(walk, kind="walk", target=event.id)
    columns = {name: getattr(edges, name).tolist() for name in SHOWN}
    for row, (source, target) in enumerate(zip(edges.source.tolist(), edges.target.tolist(), strict=True)):
        graph.add_edge(events[source].id, walk_ids[target], **{name: values[row] for name, values in columns.items()})
    runs = np.bincount(edges.target, edges.successes + edges.failures, len(events))
    for (target, end), weight in _landed(edges).items():
        graph.add_edge(walk_ids[target], events[end].id, rate=weight / runs[target])
    return graph


def _landed(edges: Edges) -> dict[tuple[int, int], float]:
    """Return the weight of the runs of each walk that ended in each event: by the index of its target, and of that event."""
    landed: dict[tuple[int, int], float] = {}
    for row, target in enumerate(edges.target.tolist()):
        ends = [(target, float(edges.successes[row]))]
        ends += zip(edges.landing[row].tolist(), edges.landing_weight[row].tolist(), strict=True)
        for end, weight in ends:
            if weight > 0.0 and end != NOWHERE:
                landed[target, end] = landed.get((target, end), 0.0) + weight
    return landed
