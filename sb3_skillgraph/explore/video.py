"""A plan as it is followed, filmed: the environment beside the graph, what was promised beside what happened."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import imageio.v2 as imageio
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from sb3_skillgraph.agent import SkillGraphAgent
from sb3_skillgraph.envs import geometry_of
from sb3_skillgraph.explore.session import Progress, Session, promised
from sb3_skillgraph.files import PARTIAL
from sb3_skillgraph.plan import Plan
from sb3_skillgraph.plotting import Trajectory
from sb3_skillgraph.plotting.figures import GOAL, disc_radius, draw_floor, project
from sb3_skillgraph.plotting.plan import draw_planned

#: Pictures a second; sides of both halves, in pixels; how long the last picture stays, in pictures.
FPS, SIDE, LAST = 20, 480, 20


def record(agent: SkillGraphAgent, env: gym.Env, path: Path, seed: int = 0) -> str:
    """Film a plan as it is followed.

    :param agent: the agent
    :param env: an environment with ``render_mode="rgb_array"``
    :param path: ``.mp4`` or ``.gif``
    :param seed: of the environment, which draws start and goal
    :return: what was promised and what happened
    :raises ValueError: if nothing can be rendered or written
    """
    if path.suffix not in (".mp4", ".gif"):
        raise ValueError(f"{path} must end in .mp4 or .gif.")
    session = Session(agent, env, seed)
    rendered(env)
    plan = session.plan()
    canvas = _Canvas(session, plan)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.stem}{PARTIAL}{path.suffix}")
    told = ""
    try:
        with _writer(partial) as writer:
            for progress in session.go():
                frame = np.concatenate([rendered(env), canvas.draw(progress)], axis=1)
                for _ in range(LAST if progress.over else 1):
                    writer.append_data(frame)
                told = f"promised: {promised(plan)}; happened: {progress.outcome}"
        if not told:
            raise ValueError("The goal is where the start is: choose another --seed.")
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
    return told


def rendered(env: gym.Env) -> np.ndarray:
    """Return a picture of an environment, uint8 of shape ``(SIDE, SIDE, 3)``.

    :param env: the environment
    :raises ValueError: if there is none, saying what is missing
    """
    if env.render_mode != "rgb_array":
        raise ValueError(f"{env.spec.id if env.spec else env} does not render pictures (render_mode 'rgb_array').")
    try:
        frame = env.render()
    except Exception as error:  # whatever a driver that is not there raises
        raise ValueError(
            f"Nothing can be rendered here ({type(error).__name__}: {error}). If it is MuJoCo that renders: without a screen "
            "it needs EGL (Debian's libegl1) or OSMesa (libosmesa6), and MUJOCO_GL=egl or MUJOCO_GL=osmesa."
        ) from error
    return np.asarray(Image.fromarray(np.asarray(frame, dtype=np.uint8)).resize((SIDE, SIDE)))


def _writer(path: Path) -> Any:
    if path.suffix == ".gif":
        return imageio.get_writer(path, mode="I", duration=1000 / FPS, loop=0)
    try:
        return imageio.get_writer(path, mode="I", fps=FPS)
    except (ImportError, ValueError) as error:
        raise ValueError(
            "MP4 needs the package imageio-ffmpeg: pip install 'sb3_skillgraph[video]'; .gif works without."
        ) from error


class _Canvas:
    """The maze and the plan, drawn once, and on it where the agent has been."""

    def __init__(self, session: Session, plan: Plan) -> None:
        self.plan = plan
        figure = Figure(figsize=(SIDE / 100, SIDE / 100), dpi=100, layout="constrained")
        self.canvas = FigureCanvasAgg(figure)
        axes, agent, geometry = figure.add_subplot(), session.agent, geometry_of(session.env)
        centers = np.vstack([agent.graph.centers, session.start, session.goal])
        draw_floor(axes, geometry, centers, 2.0 * disc_radius(agent))
        axes.plot(*project(agent.graph.centers).T, "o", color="#999999", markersize=2)
        draw_planned(axes, agent, geometry, Trajectory(session.start[None], [], session.goal, False), plan)
        axes.plot(*project(session.goal[None]).T, "*", color=GOAL, markersize=12)
        self.title = axes.set_title("", fontsize=9)
        (self.trace,) = axes.plot([], [], color="#4477aa", linewidth=2.5, zorder=9)
        (self.agent,) = axes.plot([], [], "o", color="#ffffff", markeredgecolor="#111111", markeredgewidth=2, zorder=10)

    def draw(self, progress: Progress) -> np.ndarray:
        """Return the picture, uint8 of shape ``(SIDE, SIDE, 3)``."""
        happened = progress.outcome if progress.over else f"step {len(progress.options)}: {progress.options[-1]}"
        self.title.set_text(f"Promised: {promised(self.plan)}\nHappened: {happened}")
        self.trace.set_data(*project(progress.points).T)
        self.agent.set_data(*project(progress.points[-1:]).T)
        self.canvas.draw()
        return np.asarray(self.canvas.buffer_rgba())[:, :, :3]
