"""Figures say what the agent knows, and what happened."""

import itertools
import runpy
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from conftest import TOY, new_agent
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from sb3_skillgraph import SkillGraphAgent, plotting
from sb3_skillgraph.choices import EXPECTED
from sb3_skillgraph.envs import MazeGeometry
from sb3_skillgraph.envs.maze_geometry import U_MAZE
from sb3_skillgraph.planning import DIRECT
from sb3_skillgraph.plotting import event_links, near_links, plot_plan, plot_skill_graph, run_plan, save_figure
from sb3_skillgraph.plotting.figures import project
from sb3_skillgraph.plotting.plan import MAX_NAMED
from sb3_skillgraph.plotting.skill_graph import NEAREST, SURE, EventLink

EXAMPLES = Path(__file__).parent.parent / "examples"


@pytest.fixture(scope="module")
def env() -> Iterator[gym.Env]:
    env = gym.make(TOY)
    yield env
    env.close()


@pytest.fixture(scope="module")
def agent(trained_files: tuple[Path, Path]) -> SkillGraphAgent:
    return SkillGraphAgent.load(trained_files[0], env=gym.make(TOY))


@pytest.fixture
def geometry(env: gym.Env) -> Any:
    return env.get_wrapper_attr("geometry")


def links_of(axes: Axes) -> list[np.ndarray]:
    collections = [collection for collection in axes.collections if isinstance(collection, LineCollection)]
    assert len(collections) == 1
    return collections[0].get_segments()


# -- the skill graph --------------------------------------------------------------------------------------------------


def test_one_dot_per_event_and_one_line_per_link(agent: SkillGraphAgent, geometry: Any) -> None:
    axes = plot_skill_graph(agent, geometry)
    dots = [line.get_xydata() for line in axes.lines]
    assert {(line.get_marker(), line.get_linestyle()) for line in axes.lines} == {("o", "None")}
    landmarks, salient = (np.stack([e.center for e in agent.events if e.salient == kind]) for kind in (False, True))
    np.testing.assert_allclose(dots[0], landmarks)
    np.testing.assert_allclose(dots[1], salient)
    links = near_links(event_links(agent))
    centers = {event.id: event.center for event in agent.events}
    expected = {(*centers[link.source], *centers[link.target]) for link in links}
    assert len(links) == len(links_of(axes)) > len(agent.events)
    assert {(*line[0], *line[-1]) for line in links_of(axes)} == expected
    summary = agent.graph_summary()
    title = axes.get_title()
    assert f"{summary['events']} events, {summary['salient_events']} of them salient; {summary['edges']} edges" in title


def test_no_link_goes_through_a_wall() -> None:
    geometry = MazeGeometry(U_MAZE)
    agent = new_agent(gym.make("SkillGraph/PointMazeUMaze-v0"))
    for center in [(0.9, 0.9), (-0.9, 0.9), (-0.9, -0.9), (0.9, -0.9)]:
        agent.graph.add_event(np.array(center), salient=False)
    for source, target in [(0, 1), (1, 2), (3, 2), (1, 3)]:  # the second leads through the wall in the middle
        for _ in range(3):
            agent.graph.ran(source, target, True, target, 10.0)
    lines = links_of(plot_skill_graph(agent, geometry))
    assert len(lines) == 4 and max(len(line) for line in lines) > 2
    points = np.concatenate(
        [a + np.linspace(0, 1, 50)[:, None] * (b - a) for line in lines for a, b in itertools.pairwise(line)]
    )
    for x, y, width, height in geometry.walls():
        low, high = np.array([x, y]) + 1e-6, np.array([x + width, y + height]) - 1e-6
        assert not ((low < points) & (points < high)).all(axis=1).any()


def test_there_is_a_link_for_every_edge_of_the_graph(agent: SkillGraphAgent) -> None:
    edges, walks = agent.graph.edges, agent.parts.planner.choice_model.walks()
    links = event_links(agent)
    ids = [event.id for event in agent.events]
    assert [(link.source, link.target) for link in links] == [
        (ids[u], ids[v]) for u, v in zip(edges.source.tolist(), edges.target.tolist(), strict=True)
    ]
    np.testing.assert_allclose([link.success_probability for link in links], walks.success(EXPECTED))
    assert all(0.0 <= link.success_probability <= 1.0 and link.steps > 0.0 for link in links)


def test_of_each_event_the_shortest_sure_links_are_drawn(agent: SkillGraphAgent) -> None:
    links = event_links(agent)
    shown = near_links(links)
    for event in agent.events:
        sure = sorted(link.steps for link in links if link.source == event.id and link.success_probability >= SURE)
        assert sorted(link.steps for link in shown if link.source == event.id) == sure[:NEAREST]
    assert [link for link in links if link in shown] == shown


def test_doubtful_links_are_left_out() -> None:
    sure = [EventLink("e0", f"e{i}", 0.9, float(i)) for i in range(1, NEAREST + 3)]
    doubtful = EventLink("e0", "e9", SURE - 0.01, 0.5)
    assert near_links([doubtful, *sure]) == sure[:NEAREST]


def test_it_draws_on_given_axes(agent: SkillGraphAgent, geometry: Any) -> None:
    axes = Figure().add_subplot()
    assert plot_skill_graph(agent, geometry, ax=axes) is axes
    assert axes.get_xlim() == geometry.extent[:2]


def test_without_geometry_and_before_learning() -> None:
    axes = plot_skill_graph(new_agent())
    assert axes.get_xlabel() == "goal[0]"
    assert not axes.lines
    assert len(links_of(axes)) == 0
    assert axes.get_title().startswith("Skill graph: 0 events")


def test_without_geometry_all_events_are_in_view(agent: SkillGraphAgent) -> None:
    axes = plot_skill_graph(agent)
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("goal[0]", "goal[1]")
    points = np.concatenate([line.get_xydata() for line in axes.lines])
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    assert ((points > [left, bottom]) & (points < [right, top])).all()


def test_nothing_touches_pyplot() -> None:
    sources = list(Path(plotting.__file__).parent.glob("*.py"))
    assert len(sources) >= 5
    assert not any("pyplot" in source.read_text() for source in sources)


# -- a plan -----------------------------------------------------------------------------------------------------------


def test_run_plan_records_the_episode(agent: SkillGraphAgent, env: gym.Env) -> None:
    start, goal = np.array([-1.0, 1.0]), np.array([-1.0, -1.0])
    trajectory, plan = run_plan(agent, env, start, goal)
    assert trajectory.points.shape == (len(trajectory.options) + 1, 2)
    np.testing.assert_allclose(trajectory.points[0], start)
    np.testing.assert_allclose(trajectory.goal, goal)
    assert set(trajectory.options) <= {option.id for option in agent.options} | {DIRECT}
    assert trajectory.options[0] == plan.path[0]
    at_goal = np.linalg.norm(trajectory.points - goal, axis=1) <= agent.event_radius
    assert at_goal.any() == at_goal[-1] == trajectory.success
    assert plan == agent.plan({"observation": start, "achieved_goal": start, "desired_goal": goal})


def test_start_at_the_goal(agent: SkillGraphAgent, env: gym.Env, geometry: Any) -> None:
    trajectory, plan = run_plan(agent, env, np.array([-1.0, 1.0]), np.array([-1.0, 1.1]))
    assert trajectory.success and len(trajectory.options) == 0
    assert "after 0 steps" in plot_plan(agent, geometry, trajectory, plan).get_title()


def test_every_run_is_drawn_and_the_plan_beside_it(agent: SkillGraphAgent, env: gym.Env, geometry: Any) -> None:
    trajectory, plan = run_plan(agent, env, np.array([-1.0, 1.0]), np.array([-1.0, -1.0]))
    axes = plot_plan(agent, geometry, trajectory, plan)
    runs = [option for option, _ in itertools.groupby(trajectory.options)]
    assert len(runs) >= 2
    targets = {option.id: option.target for option in agent.options}
    labels = ["walk to the goal itself" if run == DIRECT else f"{run} to {targets[run]}" for run in runs]
    planned, *walked, start, goal = axes.lines
    assert len(walked) == len(labels)
    named = [line.get_label() for line in walked if not line.get_label().startswith("_")]  # so matplotlib calls the others
    assert named == labels[:MAX_NAMED]
    np.testing.assert_allclose(np.concatenate([line.get_xydata()[1:] for line in walked]), trajectory.points[1:])
    assert planned.get_linestyle() == "--"
    stops = [
        trajectory.points[0],
        *(e.center for id in plan.path[1:-1:2] for e in agent.events if e.id == id),
        trajectory.goal,
    ]
    corners = [tuple(point) for point in np.round(planned.get_xydata(), 6).tolist()]  # and those of walls in between
    at = [corners.index(tuple(stop)) for stop in np.round(np.stack(stops), 6).tolist()]
    assert at == sorted(at) and (at[0], at[-1]) == (0, len(corners) - 1)
    assert (start.get_label(), goal.get_label()) == ("start", "goal")
    legend = axes.get_legend()
    assert legend is not None
    assert {*labels, "start", "goal"} <= {text.get_text() for text in legend.get_texts()}
    assert f"{plan.success_probability:.0%}" in axes.get_title()
    circles = [patch for patch in axes.patches if isinstance(patch, Circle)]
    assert len(circles) == len(stops) - 1  # the events of the plan, and the goal


# -- what figures share -----------------------------------------------------------------------------------------------


def test_save_figure_makes_folders(agent: SkillGraphAgent, tmp_path: Path) -> None:
    path = tmp_path / "a" / "b.png"
    save_figure(plot_skill_graph(agent), path)
    assert path.read_bytes().startswith(b"\x89PNG")


def test_a_picture_needs_an_ending(agent: SkillGraphAgent, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no ending"):
        save_figure(plot_skill_graph(agent), tmp_path / "graph")


def test_project_takes_any_dimension() -> None:
    assert project(np.ones((4, 5))).shape == (4, 2)
    np.testing.assert_allclose(project(np.array([[3.0]])), [[3.0, 0.0]])


def test_three_dimensional_goals_are_drawn_by_two() -> None:
    window_cube = runpy.run_path(str(EXAMPLES / "own_environment.py"))["WindowCube"]
    agent = new_agent(window_cube(), learning_starts=100).learn(500)
    axes = plot_skill_graph(agent)
    assert axes.get_xlabel() == "goal[0] (of 3 goal dimensions)"
    assert sum(len(line.get_xydata()) for line in axes.lines) == len(agent.events) >= 3
    trajectory, plan = run_plan(agent, window_cube())
    assert plot_plan(agent, None, trajectory, plan).get_ylabel() == "goal[1] (of 3 goal dimensions)"
