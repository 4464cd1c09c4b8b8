"""Looking at an agent: what is drawn, planned, exported and filmed. The page itself: test_explore_browser.py."""

import json
import re
import socket
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import gymnasium as gym
import imageio.v3 as imageio
import networkx as nx
import numpy as np
import pytest
from conftest import TOY, new_agent
from test_paper import small

from sb3_skillgraph import SkillGraphAgent, cli
from sb3_skillgraph.envs import geometry_of
from sb3_skillgraph.explore.export import export
from sb3_skillgraph.explore.scene import CLICK_RADIUS, Scene
from sb3_skillgraph.explore.session import Session, promised, record_of
from sb3_skillgraph.explore.video import record
from sb3_skillgraph.plan import next_best
from sb3_skillgraph.plotting import event_links, near_links, run_plan, snapshot

Capture = pytest.CaptureFixture[str]
START, END = np.array([-1.0, 1.0]), np.array([-1.0, -1.0])


@pytest.fixture
def session(trained: SkillGraphAgent) -> Session:
    session = Session(trained, gym.make(TOY))
    session.place("start", (0, 1), START)
    session.place("goal", (0, 1), END)
    return session


@pytest.fixture
def scene(trained: SkillGraphAgent) -> Scene:
    return Scene(trained, geometry_of(gym.make(TOY)))


class Pictures(gym.Wrapper):
    """Renders grey squares, or fails to."""

    def __init__(self, error: Exception | None = None) -> None:
        super().__init__(gym.make(TOY))
        self.error = error

    @property
    def render_mode(self) -> str:
        return "rgb_array"

    def render(self) -> Any:
        if self.error is not None:
            raise self.error
        return np.full((60, 80, 3), 128, dtype=np.uint8)


# -- the scene --------------------------------------------------------------------------------------------------------


def test_clicks_are_where_things_are_drawn(scene: Scene, trained: SkillGraphAgent) -> None:
    points = np.random.default_rng(0).uniform(-1.0, 1.0, (20, 2))
    for point, (x, y) in zip(points, scene.frame.pixels(points), strict=True):
        np.testing.assert_allclose(scene.frame.at(x, y), point)
    event = trained.events[2]
    x, y = scene.frame.pixels(event.center[None])[0]
    assert scene.event_at(x + 1, y - 1) is event
    assert scene.event_at(-5 * CLICK_RADIUS, y) is None


def test_a_picture_has_all_events_and_the_short_walks(scene: Scene, trained: SkillGraphAgent, session: Session) -> None:
    plan, progress = session.plan(), list(session.go())[-1]
    layers = [scene.floor(), scene.graph(), scene.plan(START, END, plan.path), scene.ends(START, END)]
    picture = ElementTree.fromstring(scene.document(*layers, scene.trace(progress.points, progress.options)))
    tags = [element.tag.rpartition("}")[2] for element in picture.iter()]
    ids = [element.get("id") for element in picture if element.get("id")]
    assert ids == [event.id for event in trained.events]
    n_runs = sum(one != other for one, other in zip(["", *progress.options], progress.options, strict=False))
    assert tags.count("polyline") == len(near_links(event_links(trained))) + 1 + n_runs
    assert tags.count("rect") == 1 + len(geometry_of(gym.make(TOY)).walls())  # type: ignore[union-attr]


def test_a_snapshot_is_drawn_as_it_was(scene: Scene, trained: SkillGraphAgent) -> None:
    seen = json.loads(json.dumps(snapshot(trained)))
    drawn = scene.growing(seen["centers"], seen["links"])
    assert drawn.count("<circle") == len(trained.events) and drawn.count("<polyline") == len(seen["links"])
    assert scene.growing([], []) == ""


def test_two_of_several_dimensions_are_shown() -> None:
    agent = new_agent(gym.make("SkillGraph/PointKeyDoor-v0")).learn(300)
    scene = Scene(agent, None, (1, 2))
    assert scene.frame.dims == (1, 2)
    assert scene.frame.size == Scene(agent, geometry_of(gym.make("SkillGraph/PointKeyDoor-v0"))).frame.size
    assert scene.graph().count("<circle") == len(agent.events)


# -- a visitor --------------------------------------------------------------------------------------------------------


def test_what_happens_is_what_the_environment_does(session: Session, trained: SkillGraphAgent) -> None:
    trajectory, plan = run_plan(trained, gym.make(TOY), START, END)
    assert session.plan() == plan
    steps = list(session.go())
    np.testing.assert_array_equal(steps[-1].points, trajectory.points)
    assert steps[-1].options == trajectory.options
    assert (steps[-1].over, steps[-1].success) == (True, trajectory.success)
    assert [step.over for step in steps[:-1]] == [False] * (len(steps) - 1)


def test_the_next_best_plan_begins_otherwise_and_costs_more(session: Session, trained: SkillGraphAgent) -> None:
    plan, other = session.plan(), session.next_best()
    assert other is not None and other.path[0] != plan.path[0]
    empty = new_agent()
    assert next_best(empty.parts.runner, START, END) is None
    assert promised(plan) == f"probability {plan.success_probability:.0%}, about {plan.expected_steps:.0f} steps"


def test_the_papers_rules_are_shown_too() -> None:
    agent = small().learn(4_000, log_interval=None)
    session = Session(agent, gym.make(TOY))
    assert session.next_best() is None
    assert promised(session.plan()).startswith("probability")
    for event in agent.events:
        record = record_of(agent, event, event_links(agent))
        assert record["id"] == event.id and all(row["succeeded"] == "-" for row in record["rows"])
    option = agent.graph.nx
    assert any(option.out_degree(id) for id, vertex in option.nodes(data=True) if vertex["kind"] != "event")
    Scene(agent, geometry_of(session.env)).graph()


def test_a_place_in_a_wall_changes_nothing(session: Session) -> None:
    with pytest.raises(ValueError, match="free space"):
        session.place("goal", (0, 1), np.array([0.0, 0.0]))
    assert (session.goal == END).all()
    with pytest.raises(ValueError, match="free space"):
        session.place("start", (0, 1), np.array([9.0, 0.0]))
    assert session.plan().path[-1] == "goal"


def test_an_environment_that_begins_where_it_likes(trained: SkillGraphAgent) -> None:
    class Own(gym.Wrapper):
        def reset(self, **_: Any) -> Any:
            return self.env.reset(options={"start": START})

    session = Session(trained, Own(gym.make(TOY)))
    session.place("goal", (0, 1), END)  # it is told another goal than its own
    assert session.plan() == trained.plan({**session.env.reset()[0], "desired_goal": END.astype(np.float32)})
    with pytest.raises(ValueError, match="begins where it likes"):
        session.place("start", (0, 1), END)


def test_an_environment_that_draws_where_it_begins() -> None:
    class Drawn(gym.Wrapper):
        def reset(self, *, seed: int | None = None, **_: Any) -> Any:
            return self.env.reset(seed=seed, options={"start": np.random.default_rng(seed).uniform(-1.2, -0.8, 2)})

    session = Session(new_agent(Drawn(gym.make(TOY))).learn(300), Drawn(gym.make(TOY)))
    begun = session.start
    session.place("goal", (0, 1), -END)
    np.testing.assert_array_equal(next(session.go()).points[0], begun)


def test_a_record_tells_of_runs_and_where_they_landed(trained: SkillGraphAgent) -> None:
    graph, edges = trained.graph, trained.graph.edges
    row = int((edges.successes + edges.failures).argmax())
    source, target = (trained.events[int(end[row])] for end in (edges.source, edges.target))
    known = record_of(trained, source, event_links(trained))
    option = next(one for one in known["rows"] if one["to"] == target.id)
    assert option["option"] == graph.walk_ids[int(edges.target[row])]
    assert option["succeeded"] == round(float(edges.successes[row]), 1)
    assert re.fullmatch(r"(e\d+ \d+%(, )?)+", option["lands in"])
    reached_by = record_of(trained, target, event_links(trained))["reached_by"]
    assert reached_by.startswith(f"{option['option']} can begin in ") and source.id in re.findall(r"e\d+", reached_by)


def test_a_port_that_is_taken(trained_files: tuple[Path, Path], capsys: Capture) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert cli.main(["explore", str(trained_files[0]), "--env", TOY, "--port", str(port), "--no-browser"]) == 2
    assert f"port {port} cannot be had" in capsys.readouterr().err


# -- files ------------------------------------------------------------------------------------------------------------


def test_exports_hold_the_whole_graph(trained: SkillGraphAgent, tmp_path: Path) -> None:
    for ending in ("graphml", "json", "html"):
        export(trained, tmp_path / f"graph.{ending}", geometry_of(gym.make(TOY)), "A <title>" if ending == "html" else "")
    read = nx.read_graphml(tmp_path / "graph.graphml")
    assert set(read.nodes) == set(trained.graph.nx.nodes) and set(read.edges) == set(trained.graph.nx.edges)
    linked = nx.node_link_graph(json.loads((tmp_path / "graph.json").read_text()), edges="edges")
    assert nx.utils.graphs_equal(linked, trained.graph.nx)
    page = (tmp_path / "graph.html").read_text()
    assert set(re.findall(r'https?://[^"\s]+', page)) == {"http://www.w3.org/2000/svg"}  # a name, which nobody asks for
    records = json.loads(page.partition("const events = ")[2].partition(";\n")[0])
    assert list(records) == [event.id for event in trained.events]
    assert "A &lt;title&gt;" in page
    with pytest.raises(ValueError, match=r"must end in \.graphml, \.json, \.html"):
        export(trained, tmp_path / "graph.xml")


def test_a_video_shows_the_environment_and_the_plan(trained: SkillGraphAgent, tmp_path: Path) -> None:
    told = record(trained, Pictures(), tmp_path / "new" / "plan.gif", seed=1)
    assert re.fullmatch(r"promised: probability \d+%, about \d+ steps; happened: goal (reached|missed) after \d+ steps", told)
    frames = imageio.imread(tmp_path / "new" / "plan.gif")
    assert frames.shape[1:] == (480, 960, 3)
    assert (frames[0][:, :480] == 128).all() and frames[0][:, 480:].std() > 30
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["plan.gif"]


def test_goals_of_one_dimension(tmp_path: Path) -> None:
    class Line(gym.ObservationWrapper):
        success_radius = 0.3
        render_mode = "rgb_array"

        def __init__(self) -> None:
            super().__init__(gym.make(TOY, max_steps=50))
            box = gym.spaces.Box(-2.0, 2.0, (1,), np.float32)
            self.observation_space = gym.spaces.Dict(dict.fromkeys(("observation", "achieved_goal", "desired_goal"), box))

        def observation(self, observation: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
            return {key: value[:1] for key, value in observation.items()}

        def reset(self, *, seed: int | None = None) -> Any:  # it takes no options
            observation, info = self.env.reset(seed=seed)
            return self.observation(observation), info

        def render(self) -> Any:
            return np.zeros((10, 10, 3), dtype=np.uint8)

    env = Line()
    agent = new_agent(env, option_view="relative", event_radius=0.3).learn(400)
    export(agent, tmp_path / "graph.html")
    assert "happened" in record(agent, env, tmp_path / "line.gif", seed=1)


@pytest.mark.parametrize(
    ("env", "name", "message"),
    [
        (lambda: gym.make(TOY), "plan.gif", "does not render"),
        (lambda: Pictures(RuntimeError("no display")), "plan.gif", "no display.*libegl1.*MUJOCO_GL=osmesa"),
        (Pictures, "plan.avi", "must end in .mp4 or .gif"),
    ],
)
def test_what_cannot_be_filmed(trained: SkillGraphAgent, tmp_path: Path, env: Any, name: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        record(trained, env(), tmp_path / name)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("command", [["explore", "--no-browser"], ["export", "--out", "x.html"], ["video", "--out", "x.gif"]])
def test_a_file_that_is_no_agent_gets_one_line(command: list[str], tmp_path: Path, capsys: Capture) -> None:
    (tmp_path / "agent.zip").write_text("no agent")
    name, *rest = command
    assert cli.main([name, str(tmp_path / "agent.zip"), "--env", TOY, *rest]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "Cannot load" in error


@pytest.mark.parametrize("name", ["point_medium", "ant_umaze"])
def test_the_trained_agents_work_at_once(name: str, tmp_path: Path, capsys: Capture) -> None:
    folder = Path(__file__).parent.parent / "examples" / "agents" / name
    assert (folder / "agent.zip").stat().st_size <= 2_000_000
    assert cli.main(["export", str(folder), "--out", str(tmp_path / "graph.html")]) == 0
    assert cli.main(["evaluate", str(folder), "--pairs", "3"]) == 0
    assert "100%" in capsys.readouterr().out
