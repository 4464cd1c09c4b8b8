"""A skill graph for other programs, or as a page that needs no network."""

import html
import json
import string
from importlib.resources import files
from pathlib import Path
from typing import Any

from sb3_skillgraph.agent import SkillGraphAgent
from sb3_skillgraph.envs import MazeGeometry
from sb3_skillgraph.explore.scene import Scene
from sb3_skillgraph.explore.session import record_of
from sb3_skillgraph.files import write_text


def export(agent: SkillGraphAgent, path: Path, geometry: MazeGeometry | None = None, title: str = "Skill graph") -> None:
    """Write an agent's skill graph.

    :param agent: the agent
    :param path: ``.graphml``, ``.json`` (networkx's node-link data) or ``.html``
    :param geometry: its maze, for the page; None for an environment without one
    :param title: of the page
    :raises ValueError: if the ending is another one
    """
    kinds = {".graphml": _graphml, ".json": _node_link, ".html": lambda agent: _page(agent, geometry, title)}
    if path.suffix not in kinds:
        raise ValueError(f"{path} must end in {', '.join(kinds)}.")
    write_text(path, kinds[path.suffix](agent) + "\n")


def _graphml(agent: SkillGraphAgent) -> str:
    import networkx  # when it is used: it takes a while to import

    return "\n".join(networkx.generate_graphml(agent.graph.nx))


def _node_link(agent: SkillGraphAgent) -> str:
    import networkx

    return json.dumps(networkx.node_link_data(agent.graph.nx, edges="edges"), indent=1)


def _page(agent: SkillGraphAgent, geometry: MazeGeometry | None, title: str) -> str:
    scene = Scene(agent, geometry, (0, min(1, agent.graph.goal_dim - 1)))
    summary = agent.graph_summary()
    counts = f"{summary['events']} events, {summary['salient_events']} of them salient; {summary['edges']} edges"
    events: dict[str, Any] = {
        event.id: {**record_of(agent, event, scene.links), "drawn": scene.selected(event)} for event in agent.events
    }
    template = string.Template(files("sb3_skillgraph.explore").joinpath("graph.html").read_text(encoding="utf-8"))
    return template.substitute(
        title=html.escape(title),
        counts=counts,
        picture=scene.document(scene.floor(), '<g id="selected"></g>', scene.graph()),
        # A closing tag within a text would end the script.
        events=json.dumps(events).replace("</", "<\\/"),
    )
