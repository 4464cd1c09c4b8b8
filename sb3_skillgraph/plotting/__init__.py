"""Figures: the skill graph over the maze, and one executed plan. Nothing here touches matplotlib's global state."""

from sb3_skillgraph.plotting.figures import save_figure
from sb3_skillgraph.plotting.plan import Trajectory, plot_plan, run_plan
from sb3_skillgraph.plotting.skill_graph import event_links, near_links, plot_skill_graph, snapshot

__all__ = ["Trajectory", "event_links", "near_links", "plot_plan", "plot_skill_graph", "run_plan", "save_figure", "snapshot"]
