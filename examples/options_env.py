"""Options as actions: the graph's planner and SMDP Q-learning on one maze: ``python examples/options_env.py`` (minutes)."""

import argparse

import gymnasium as gym
import torch as th
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor

from sb3_skillgraph import GraphPolicy, OptionsEnv, SkillGraphAgent, SMDPQLearning

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--env", default="SkillGraph/PointMazeUMaze-v0", help="a SkillGraph/* environment")
parser.add_argument("--steps", type=int, default=20_000, help="environment steps in which the agent finds its options")
parser.add_argument("--decisions", type=int, default=2_000, help="options that Q-learning runs to learn which to choose")
args = parser.parse_args()

th.set_num_threads(1)  # small networks are faster on one thread

agent = SkillGraphAgent("MultiInputPolicy", gym.make(args.env), seed=0)
agent.learn(args.steps, progress_bar=True)

maze = gym.make(args.env, terminate_on_success=True)
env = OptionsEnv(maze, agent.options, max_options=512, route=agent.planner.route)
observation, info = env.reset(seed=0)
n_always = 1 + len(env.primitives)  # the global option and primitive actions
print(f"{env.action_masks().sum() - n_always} of {len(agent.options)} options can run here, and {n_always} other actions")

planner = GraphPolicy(agent.planner, env)
learner = SMDPQLearning("MultiInputPolicy", Monitor(env), learning_starts=100, seed=0)
learner.learn(args.decisions, progress_bar=True)
for name, policy in (("planning over the graph", planner), ("SMDP Q-learning", learner)):
    mean, deviation = evaluate_policy(policy, Monitor(env), n_eval_episodes=20)
    print(f"{name}: {mean:.2f} ± {deviation:.2f} discounted reward, 1 for being there at once")
