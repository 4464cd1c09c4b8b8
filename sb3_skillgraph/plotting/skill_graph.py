"""The skill graph as a picture over the maze (the paper's Figure 4)."""

from typing import NamedTuple

import networkx as nx
import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap, Normalize, to_rgb
from matplotlib.lines import Line2D
from matplotlib.patches import FancyArrowPatch, Patch

from sb3_skillgraph.agent import SkillGraphAgent
from sb3_skillgraph.envs import MazeGeometry
from sb3_skillgraph.graph import SkillGraph
from sb3_skillgraph.plotting import figures

_GRID = 250  # cells along the longer side on which initiation sets are evaluated
_MAX_VISITED, _MAX_EFFECTS = 4000, 8  # dots in all, and per option: more only blacken the picture
_LINKS = LinearSegmentedColormap.from_list("links", colormaps["plasma"](np.linspace(0.0, 0.88, 64)))


class EventLink(NamedTuple):
    """A way from one event to another with no third in between.

    :param source: id of the event it leaves
    :param target: id of the event it leads to
    :param success_probability: product of the edges' success rates
    :param cost: sum of the edges' weights, in option runs
    """

    source: str
    target: str
    success_probability: float
    cost: float


def event_links(graph: SkillGraph) -> list[EventLink]:
    """Find the events that are joined by options alone.

    :param graph: the skill graph
    :return: one link per ordered pair of events that has such a path, for the cheapest one
    """
    links = []
    for source in graph.events:
        ways = nx.subgraph_view(graph.nx, filter_edge=lambda u, v, source=source: u == source or u not in graph.events)
        costs, paths = nx.single_source_dijkstra(ways, source, weight="weight")
        links += [
            EventLink(source, target, graph.success_probability(path), costs[target])
            for target, path in paths.items()
            if target in graph.events and target != source
        ]
    return links


def near_links(links: list[EventLink]) -> list[EventLink]:
    """
    Leave out the links that shorter ones explain.

    A link goes if some third event is nearer to both its ends than they are to each other, as in a relative
    neighbourhood graph; what could be reached over links still can.

    :param links: all links
    :return: those that remain, in the same order
    """
    costs = {(link.source, link.target): link.cost for link in links}
    events = {link.source for link in links}

    def explained(link: EventLink) -> bool:
        return any(
            max(costs.get((link.source, event), np.inf), costs.get((event, link.target), np.inf)) < link.cost
            for event in events
        )

    return [link for link in links if not explained(link)]


def plot_skill_graph(agent: SkillGraphAgent, geometry: MazeGeometry | None = None, ax: Axes | None = None) -> Axes:
    """
    Draw what an agent has discovered: events, how they are joined, and where its options start and end.

    An arrow joins two events that options alone lead between, unless shorter arrows explain it (:func:`near_links`).
    Goal spaces of more than two dimensions are drawn by their first two; initiation sets then show as the visited
    states inside them.

    :param agent: the agent
    :param geometry: the maze, for its walls; None for an environment without one
    :param ax: axes to draw on; None for a new figure
    :return: the axes
    """
    axes = figures.new_axes() if ax is None else ax
    events = agent.events
    centers = [event.center[None] for event in events]
    seen = np.concatenate([agent.visited.points, *centers]) if agent.visited.size or events else np.zeros((1, 2))
    figures.draw_floor(axes, geometry, seen, agent.event_radius)
    _draw_visited(axes, agent)
    _draw_regions(axes, agent)
    _draw_effects(axes, agent)
    links = near_links(event_links(agent.graph))
    _draw_links(axes, agent, links)
    _draw_events(axes, agent)
    n_options = len(agent.graph.options)
    axes.set_title(f"Skill graph: {len(events)} salient events, {n_options} options, {len(links)} links between events")
    _draw_key(axes)
    return axes


def _draw_visited(axes: Axes, agent: SkillGraphAgent) -> None:
    points = figures.project(agent.visited.points)
    if len(points):
        shown = points[:: -(-len(points) // _MAX_VISITED)]
        axes.plot(*shown.T, ".", color=figures.VISITED, markersize=1.5, alpha=0.35, zorder=figures.Z_VISITED)


def _draw_regions(axes: Axes, agent: SkillGraphAgent) -> None:
    """Shade the union of the optimistic initiation sets, darker where more options can start."""
    bank = agent.graph.option_bank
    if not bank.options:
        return
    if len(agent.events[0].center) != 2:
        points = agent.visited.points
        startable = figures.project(points[bank.startable(points)[1].any(axis=1)])
        axes.plot(*startable.T, "s", color=figures.REGION, markersize=4, alpha=0.5, zorder=figures.Z_REGION)
        return
    left, right = axes.get_xlim()
    bottom, top = axes.get_ylim()
    step = max(right - left, top - bottom) / _GRID
    x, y = np.arange(left + step / 2, right, step), np.arange(bottom + step / 2, top, step)
    grid = np.stack(np.meshgrid(x, y), axis=-1)
    n_startable = np.stack([bank.startable(row)[1].sum(axis=1) for row in grid])
    image = np.empty((*n_startable.shape, 4))
    image[..., :3] = to_rgb(figures.REGION)
    image[..., 3] = np.where(n_startable > 0, 0.3 + 0.6 * n_startable / n_startable.max(), 0.0)
    extent = (x[0] - step / 2, x[-1] + step / 2, y[0] - step / 2, y[-1] + step / 2)
    axes.imshow(image, origin="lower", extent=extent, zorder=figures.Z_REGION, interpolation="nearest")


def _draw_effects(axes: Axes, agent: SkillGraphAgent) -> None:
    effects = [point for option in agent.graph.options.values() for point in list(option.effects)[-_MAX_EFFECTS:]]
    if effects:
        points = figures.project(np.stack(effects))
        axes.plot(*points.T, "x", color=figures.EFFECT, markersize=3, alpha=0.6, zorder=figures.Z_EFFECT)


def _draw_links(axes: Axes, agent: SkillGraphAgent, links: list[EventLink]) -> None:
    scale = Normalize(0.0, 1.0)
    # The surest ways last, on top of the others.
    for link in sorted(links, key=lambda link: link.success_probability):
        ends = [figures.project(agent.graph.events[id].center[None])[0] for id in (link.source, link.target)]
        arrow = FancyArrowPatch(
            tuple(ends[0]),
            tuple(ends[1]),
            # Bent, so that the way there and the way back are two arrows.
            connectionstyle="arc3,rad=0.12",
            arrowstyle="-|>",
            mutation_scale=9,
            linewidth=1.4,
            color=_LINKS(scale(link.success_probability)),
            shrinkA=7,
            shrinkB=7,
            zorder=figures.Z_LINK,
            label=f"{link.source} -> {link.target}",
        )
        axes.add_patch(arrow)
    figure = axes.get_figure(root=False)
    assert figure is not None
    figure.colorbar(
        ScalarMappable(scale, _LINKS), ax=axes, shrink=0.6, label="success probability of the way between two events"
    )


def _draw_events(axes: Axes, agent: SkillGraphAgent) -> None:
    for event in agent.events:
        figures.draw_disc(
            axes,
            event.center,
            event.radius,
            facecolor="none",
            edgecolor=figures.EVENT,
            linewidth=1.0,
            linestyle="--",
            zorder=figures.Z_EVENT,
            label=event.id,
        )
        x, y = figures.project(event.center[None])[0]
        axes.annotate(
            event.id,
            (float(x), float(y)),
            ha="center",
            va="center",
            fontsize=7,
            zorder=figures.Z_LABEL,
            bbox=dict(boxstyle="circle,pad=0.2", facecolor="white", edgecolor=figures.EVENT, linewidth=0.8),
        )


def _draw_key(axes: Axes) -> None:
    handles = [
        Line2D(
            [],
            [],
            color="none",
            marker="o",
            markersize=8,
            markerfacecolor="white",
            markeredgecolor=figures.EVENT,
            label="salient event (circle: its region)",
        ),
        Line2D([], [], color=_LINKS(0.9), linewidth=1.5, marker=">", markersize=4, label="options lead from event to event"),
        Patch(facecolor=figures.REGION, label="an option can start here (darker: several)"),
        Line2D([], [], color="none", marker="x", markersize=5, markeredgecolor=figures.EFFECT, label="an option ended here"),
        Line2D([], [], color="none", marker=".", markersize=4, markeredgecolor=figures.VISITED, label="visited state"),
    ]
    axes.legend(handles=handles, loc="upper center", bbox_to_anchor=(0.5, -0.09), ncols=2, fontsize=8, frameon=False)
