"""A trained ant walks to goals of your choice, one after the other, and is filmed.

    sb3-skillgraph train SkillGraph/AntUMaze-v0 --out runs/ant
    python examples/ant_to_any_goal.py runs/ant/agent.zip --goal -4 -4 --goal 4 0 --goal -4 4

Training takes about 20 minutes. On a machine without a screen, set MUJOCO_GL=egl (without a GPU, EGL_PLATFORM=surfaceless,
too) for the film, or MUJOCO_GL=osmesa where the library OSMesa is installed.
"""

import argparse
from pathlib import Path
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
import torch as th
from PIL import Image

from sb3_skillgraph import SkillGraphAgent
from sb3_skillgraph.envs.mujoco_mazes import MujocoMazeTask
from sb3_skillgraph.experiments.console import assignment
from sb3_skillgraph.plotting import Trajectory, plot_plan, save_figure

EVERY = 4  # steps of 0.1 s between two frames


class Film:
    """Frames of the whole maze, seen from above."""

    def __init__(self, model: mujoco.MjModel, width: float) -> None:
        self.renderer = mujoco.Renderer(model, 360, 360)
        self.camera = mujoco.MjvCamera()
        self.camera.distance, self.camera.elevation, self.camera.azimuth = width, -85.0, 90.0
        self.frames: list[Image.Image] = []

    def shoot(self, data: mujoco.MjData) -> None:
        """Add a frame."""
        self.renderer.update_scene(data, self.camera)
        self.frames.append(Image.fromarray(self.renderer.render()))

    def save(self, path: Path) -> None:
        """Write the film, at four times the speed of life."""
        self.frames[0].save(path, save_all=True, append_images=self.frames[1:], duration=100, loop=0)


def set_goal(env: gym.Env, observation: dict[str, Any], goal: np.ndarray) -> dict[str, Any]:
    """Change the goal where the ant stands, without a reset."""
    task: Any = env.unwrapped
    task.set_state({**task.get_state(), "goal": goal, "elapsed_steps": np.array(0), "has_succeeded": np.array(False)})
    return {**observation, "desired_goal": goal}


def walk(agent: SkillGraphAgent, env: gym.Env, observation: dict[str, Any], film: Film) -> tuple[Trajectory, Any, bool]:
    """Go to the goal; return the way there, the last observation, and whether the ant fell on its back."""
    task: Any = env.unwrapped
    points, options = [observation["achieved_goal"]], list[str]()
    state: Any = None
    over = False
    while not over:
        action, state = agent.predict(observation, state=state, deterministic=True)
        options += agent.running(state)
        observation, _, terminated, truncated, info = env.step(action)
        points.append(observation["achieved_goal"])
        if len(options) % EVERY == 0:
            film.shoot(task.data)
        fell = bool(info.get("stuck"))
        over = terminated or truncated or fell
    goal = observation["desired_goal"]
    return Trajectory(np.stack(points), options, goal, bool(info["is_success"])), observation, fell


parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("agent", type=Path, help="a trained agent")
parser.add_argument("--env", default="SkillGraph/AntUMaze-v0", help="where it was trained")
parser.add_argument(
    "--env-kwargs", type=assignment, nargs="+", default=[], metavar="NAME=VALUE", help="of that, as it was trained"
)
parser.add_argument("--goal", type=float, nargs=2, action="append", metavar=("X", "Y"), required=True, help="in metres")
parser.add_argument("--out", type=Path, default=Path("runs/ant_to_any_goal"), help="folder for film and pictures")
args = parser.parse_args()

th.set_num_threads(1)
try:
    env = gym.make(args.env, terminate_on_success=True, **dict(args.env_kwargs))
    agent = SkillGraphAgent.load(args.agent, env=env)
    for goal in args.goal:
        observation, _ = env.reset(seed=0, options={"goal": goal})  # refuses walls
except (OSError, ValueError, TypeError, gym.error.Error) as error:
    parser.error(str(error))
if not isinstance(env.unwrapped, MujocoMazeTask):
    parser.error(f"{args.env} is no maze of MuJoCo, and cannot be filmed")
task: Any = env.unwrapped
args.out.mkdir(parents=True, exist_ok=True)
geometry = env.get_wrapper_attr("geometry")
x_min, x_max, _, _ = geometry.extent

try:
    film = Film(task.model, x_max - x_min)
except (AttributeError, RuntimeError, mujoco.FatalError) as error:  # whichever comes of there being no screen
    parser.error(f"MuJoCo cannot draw here ({error}): set MUJOCO_GL=egl")
for number, goal in enumerate(np.array(args.goal)):
    observation = set_goal(env, observation, goal)
    film.shoot(task.data)
    plan = agent.plan(observation)
    trajectory, observation, fell = walk(agent, env, observation, film)
    outcome = "reached" if trajectory.success else "fell on its back" if fell else "not reached"
    print(f"goal {goal.tolist()}: {plan.status}, {len(trajectory.options)} steps, {outcome}")
    save_figure(plot_plan(agent, geometry, trajectory, plan), args.out / f"way_{number}.png")
    if fell:
        observation, _ = env.reset()
film.save(args.out / "ant.gif")
film.frames[-1].save(args.out / "ant.png")
print(f"film and pictures are in {args.out}")
env.close()
