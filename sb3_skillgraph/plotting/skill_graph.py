"""The skill graph as a picture over the maze (the paper's Figure 4)."""

from typing import Any, NamedTuple

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize, to_hex
from matplotlib.lines import Line2D

from sb3_skillgraph.agent import SkillGraphAgent
from sb3_skillgraph.choices import EXPECTED
from sb3_skillgraph.envs import MazeGeometry
from sb3_skillgraph.plotting import figures

_LINKS = LinearSegmentedColormap.from_list("links", colormaps["plasma"](np.linspace(0.0, 0.88, 64)))
#: Success that is expected of a walk for it to be drawn.
SURE = 0.5
#: The walks of an event that are drawn: more only blacken the picture.
NEAREST = 4


_SCALE = Normalize(SURE, 1.0)


def link_color(success_probability: float) -> str:
    """Return the colour of a walk, by the success that is expected of it."""
    return to_hex(_LINKS(_SCALE(success_probability)))


class EventLink(NamedTuple):
    """A walk from one event to another; by the paper's rules, options one after the other.

    :param source: id of the event it is begun in
    :param target: id of the event it leads to
    :param success_probability: what is expected of it, by its runs and those of its kind
    :param steps: environment steps that it takes
    """

    source: str
    target: str
    success_probability: float
    steps: float


def event_links(agent: SkillGraphAgent) -> list[EventLink]:
    """Return what the agent expects of the ways from event to event.

    :param agent: the agent
    :return: one link for each edge of the graph; by the paper's rules, for each two events that options alone join
    """
    if agent.rules is not None:
        links = (agent.parts.policy.links_from(event.id) for event in agent.events)
        return [EventLink(*link) for some in links for link in some]
    graph, walks = agent.graph, agent.parts.planner.choice_model.walks()
    columns = (walks.source.tolist(), walks.target.tolist(), walks.success(EXPECTED).tolist(), walks.steps.tolist())
    return [EventLink(graph.id(u), graph.id(v), p, steps) for u, v, p, steps in zip(*columns, strict=True)]


def near_links(links: list[EventLink]) -> list[EventLink]:
    """
    Leave out doubtful links, and of each event all but the shortest.

    :param links: all links
    :return: those that remain, in the same order
    """
    sure = [link for link in links if link.success_probability >= SURE]
    by_source: dict[str, list[EventLink]] = {}
    for link in sorted(sure, key=lambda link: link.steps):
        by_source.setdefault(link.source, []).append(link)
    kept = {(link.source, link.target) for few in by_source.values() for link in few[:NEAREST]}
    return [link for link in sure if (link.source, link.target) in kept]


def snapshot(agent: SkillGraphAgent) -> dict[str, Any]:
    """Return what is seen of a graph as plain data: where its events are, and which of them walks join.

    :param agent: the agent
    """
    numbers = {event.id: i for i, event in enumerate(agent.events)}
    links = near_links(event_links(agent))
    return {
        "centers": [event.center.tolist() for event in agent.events],
        "links": [[numbers[link.source], numbers[link.target]] for link in links],
    }


def plot_skill_graph(agent: SkillGraphAgent, geometry: MazeGeometry | None = None, ax: Axes | None = None) -> Axes:
    """
    Draw what an agent has discovered: events, and the walks between them, coloured by the success expected of them.

    Of each event the shortest few walks are drawn (:func:`near_links`), as the shortest ways between the events' centres.
    Goal spaces of more than two dimensions are drawn by their first two.

    :param agent: the agent
    :param geometry: the maze, for its walls; None for an environment without one
    :param ax: axes to draw on; None for a new figure
    :return: the axes
    """
    axes = figures.new_axes() if ax is None else ax
    centers = agent.graph.centers
    figures.draw_floor(axes, geometry, centers if len(centers) else np.zeros((1, 2)), 2 * figures.disc_radius(agent))
    _draw_links(axes, agent, geometry, near_links(event_links(agent)))
    _draw_events(axes, agent)
    n_salient = sum(event.salient for event in agent.events)
    n_edges = agent.graph.summary()["edges"]
    axes.set_title(f"Skill graph: {len(agent.events)} events, {n_salient} of them salient; {n_edges} edges")
    _draw_key(axes)
    return axes


def _draw_links(axes: Axes, agent: SkillGraphAgent, geometry: MazeGeometry | None, links: list[EventLink]) -> None:
    centers = {event.id: event.center for event in agent.events}
    # The surest ways last, on top of the others.
    ordered = sorted(links, key=lambda link: link.success_probability)
    lines = [figures.way(geometry, centers[link.source], centers[link.target]) for link in ordered]
    colors = [link_color(link.success_probability) for link in ordered]
    axes.add_collection(LineCollection(lines, colors=colors, linewidths=1.1, zorder=figures.Z_LINK))
    figure = axes.get_figure(root=False)
    assert figure is not None
    figure.colorbar(ScalarMappable(_SCALE, _LINKS), ax=axes, shrink=0.6, label="success expected")


def _draw_events(axes: Axes, agent: SkillGraphAgent) -> None:
    for salient, color, size in ((False, figures.EVENT, 3.5), (True, figures.EFFECT, 7.0)):
        centers = [event.center for event in agent.events if event.salient == salient]
        if centers:
            points = figures.project(np.stack(centers))
            axes.plot(*points.T, "o", color=color, markersize=size, markeredgecolor="white", zorder=figures.Z_EVENT)


def _draw_key(axes: Axes) -> None:
    dot = dict(color="none", marker="o", markeredgecolor="white")
    handles = [
        Line2D([], [], markersize=5, markerfacecolor=figures.EVENT, label="landmark", **dot),  # type: ignore[arg-type]
        Line2D([], [], markersize=8, markerfacecolor=figures.EFFECT, label="salient event", **dot),  # type: ignore[arg-type]
        Line2D([], [], color=_LINKS(0.9), linewidth=1.5, label="options from event to event (one way at least)"),
    ]
    axes.legend(handles=handles, loc="upper center", bbox_to_anchor=(0.5, -0.09), ncols=3, fontsize=8, frameon=False)
