import runpy
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import networkx as nx
import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.patches import Circle, FancyArrowPatch

from sb3_skillgraph import SkillGraphAgent, plotting
from sb3_skillgraph.plotting import event_links, near_links, plot_plan, plot_skill_graph, run_plan, save_figure
from sb3_skillgraph.plotting.figures import project
from sb3_skillgraph.plotting.skill_graph import EventLink

TOY = "SkillGraph/ToyMaze-v0"
EXAMPLES = Path(__file__).parent.parent / "examples"


@pytest.fixture(scope="module")
def env():
    env = gym.make(TOY)
    yield env
    env.close()


@pytest.fixture(scope="module")
def agent():
    return SkillGraphAgent("MultiInputPolicy", gym.make(TOY), seed=3, learning_starts=200, batch_size=64).learn(1000)


@pytest.fixture
def geometry(env):
    return env.get_wrapper_attr("geometry")


def patches(axes, kind):
    return [patch for patch in axes.patches if isinstance(patch, kind)]


class TestSkillGraph:
    def test_one_circle_and_label_per_event_and_one_arrow_per_link(self, agent, geometry):
        axes = plot_skill_graph(agent, geometry)
        assert len(agent.events) >= 2
        circles = patches(axes, Circle)
        assert [circle.get_label() for circle in circles] == [event.id for event in agent.events]
        np.testing.assert_allclose([circle.center for circle in circles], [event.center for event in agent.events])
        assert {text.get_text() for text in axes.texts} == {event.id for event in agent.events}
        links = near_links(event_links(agent.graph))
        labels = [arrow.get_label() for arrow in patches(axes, FancyArrowPatch)]
        assert sorted(labels) == sorted(f"{link.source} -> {link.target}" for link in links) != []

    def test_links_pass_no_third_event(self, agent):
        for source, target, probability, _ in event_links(agent.graph):
            assert source != target and 0.0 < probability <= 1.0
            others = set(agent.graph.events) - {source, target}
            without = agent.graph.nx.subgraph(set(agent.graph.nx) - others)
            assert nx.has_path(without, source, target)

    def test_near_links_reach_what_all_links_reach(self, agent):
        links = event_links(agent.graph)
        everything, shown = (nx.DiGraph([link[:2] for link in kept]) for kept in (links, near_links(links)))
        assert set(nx.transitive_closure(everything).edges) == set(nx.transitive_closure(shown).edges)

    def test_a_link_over_a_third_event_is_explained(self):
        short = [EventLink("e0", "e1", 0.9, 1.1), EventLink("e1", "e2", 0.9, 1.1), EventLink("e2", "e0", 0.9, 1.1)]
        assert near_links([*short, EventLink("e0", "e2", 0.5, 2.2)]) == short

    def test_draws_on_given_axes(self, agent, geometry):
        axes = Figure().add_subplot()
        assert plot_skill_graph(agent, geometry, ax=axes) is axes
        assert axes.get_xlim() == geometry.extent[:2]

    def test_without_geometry_and_before_learning(self):
        fresh = SkillGraphAgent("MultiInputPolicy", gym.make(TOY), seed=0)
        axes = plot_skill_graph(fresh)
        assert axes.get_xlabel() == "goal[0]"
        assert not patches(axes, Circle)

    def test_does_not_touch_pyplot(self):
        sources = Path(plotting.__file__).parent.glob("*.py")
        assert not any("pyplot" in source.read_text() for source in sources)


class TestPlan:
    def test_run_plan_records_the_episode(self, agent, env):
        start, goal = np.array([-1.0, 1.0]), np.array([1.0, 1.0])
        trajectory, plan = run_plan(agent, env, start, goal)
        assert trajectory.points.shape == (len(trajectory.options) + 1, 2)
        np.testing.assert_allclose(trajectory.points[0], start)
        np.testing.assert_allclose(trajectory.goal, goal)
        assert trajectory.options.min() >= 0 and trajectory.options.max() <= len(agent.options)
        at_goal = np.linalg.norm(trajectory.points - goal, axis=1) <= agent.event_radius
        assert at_goal.any() == at_goal[-1] == trajectory.success
        assert plan == agent.plan({"observation": start, "achieved_goal": start, "desired_goal": goal})

    def test_start_at_the_goal(self, agent, env, geometry):
        trajectory, plan = run_plan(agent, env, np.array([-1.0, 1.0]), np.array([-1.0, 1.1]))
        assert trajectory.success and len(trajectory.options) == 0
        assert "after 0 steps" in plot_plan(agent, geometry, trajectory, plan).get_title()

    def test_every_run_is_drawn(self, agent, env, geometry):
        trajectory, plan = run_plan(agent, env, np.array([-1.0, 1.0]), np.array([-1.0, -1.0]))
        axes = plot_plan(agent, geometry, trajectory, plan)
        n_runs = 1 + np.count_nonzero(np.diff(trajectory.options))
        start_and_goal = 2
        assert len(axes.lines) == n_runs + start_and_goal
        names = {text.get_text().split(" (")[0] for text in axes.get_legend().get_texts()}
        ran = {"global option" if k == 0 else f"option o{k}" for k in trajectory.options}
        assert ran | {"start", "goal"} <= names


def test_save_figure_makes_folders(agent, tmp_path):
    path = tmp_path / "a" / "b.png"
    save_figure(plot_skill_graph(agent), path)
    assert path.read_bytes().startswith(b"\x89PNG")


def test_a_picture_needs_an_ending(agent, tmp_path):
    with pytest.raises(ValueError, match="no ending"):
        save_figure(plot_skill_graph(agent), tmp_path / "graph")


def test_project_takes_any_dimension():
    assert project(np.ones((4, 5))).shape == (4, 2)
    np.testing.assert_allclose(project(np.array([[3.0]])), [[3.0, 0.0]])


class TestExamples:
    def run(self, name, *arguments):
        command = [sys.executable, str(EXAMPLES / name), *arguments]
        return subprocess.run(command, check=True, capture_output=True, text=True, timeout=120).stdout

    def test_quickstart(self, tmp_path):
        printed = self.run("quickstart.py", "--env", TOY, "--steps", "400", "--out", str(tmp_path))
        assert {path.name for path in tmp_path.iterdir()} == {"agent.zip", "skill_graph.png", "plan.png"}
        assert "goal" in printed

    def test_own_environment_with_three_dimensional_goals(self):
        assert "success rate: " in self.run("own_environment.py", "--steps", "300")

    def test_three_dimensional_goals_are_drawn_by_two(self):
        window_cube = runpy.run_path(str(EXAMPLES / "own_environment.py"))["WindowCube"]
        agent = SkillGraphAgent("MultiInputPolicy", window_cube(), seed=0, learning_starts=100, batch_size=32).learn(700)
        axes = plot_skill_graph(agent)
        assert axes.get_xlabel() == "goal[0] (of 3 goal dimensions)"
        assert len(patches(axes, Circle)) == len(agent.events)
        trajectory, plan = run_plan(agent, window_cube())
        assert plot_plan(agent, None, trajectory, plan).get_ylabel() == "goal[1] (of 3 goal dimensions)"
