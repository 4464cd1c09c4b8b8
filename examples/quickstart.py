"""Train on a maze, save, load, plan, act and draw: ``python examples/quickstart.py`` (a minute or two)."""

import argparse
from pathlib import Path

import gymnasium as gym
import torch as th

from sb3_skillgraph import SkillGraphAgent
from sb3_skillgraph.callbacks import SkillGraphProgressBarCallback
from sb3_skillgraph.plotting import plot_plan, plot_skill_graph, run_plan, save_figure

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--env", default="SkillGraph/PointMazeUMaze-v0", help="a SkillGraph/* environment")
parser.add_argument("--steps", type=int, default=20_000, help="environment steps of training")
parser.add_argument("--out", type=Path, default=Path("runs/quickstart"), help="folder for the results")
args = parser.parse_args()

th.set_num_threads(1)  # small networks are faster on one thread

# No reward is used: the agent finds out by itself where it could go.
env = gym.make(args.env)
agent = SkillGraphAgent("MultiInputPolicy", env, seed=0)
agent.learn(args.steps, callback=SkillGraphProgressBarCallback())
agent.save(args.out / "agent.zip")

# Ask for a goal it was never given.
agent = SkillGraphAgent.load(args.out / "agent.zip", env=env)
observation, info = env.reset(seed=1)
plan = agent.plan(observation)
print(f"goal {observation['desired_goal']}: {plan}")

# Act as with any SB3 model; the state holds the running option, so pass it back in.
state, done = None, False
while not done:
    action, state = agent.predict(observation, state=state, deterministic=True)
    observation, reward, terminated, truncated, info = env.step(action)
    done = terminated or truncated or info["is_success"]
print("reached the goal" if info["is_success"] else "did not reach the goal: train for longer")

# Look at what it has learned.
geometry = env.get_wrapper_attr("geometry")
save_figure(plot_skill_graph(agent, geometry), args.out / "skill_graph.png")
trajectory, plan = run_plan(agent, env)
save_figure(plot_plan(agent, geometry, trajectory, plan), args.out / "plan.png")
print(f"pictures and agent are in {args.out}")
env.close()
