"""A goal space of three dimensions and an arm: success on FetchReach's own resets.

python -m benchmarks.fetch_reach --out benchmarks/results/fetch_reach.json
"""

import argparse
import json
import pathlib
import shlex
import sys
import time
from typing import Any

import gymnasium as gym
import gymnasium_robotics
import numpy as np
import torch as th
from joblib import Parallel, delayed

from sb3_skillgraph import SkillGraphAgent, __version__


def run_seed(steps: int, seed: int, n_episodes: int) -> dict[str, Any]:
    """Train one agent and test it on the environment's own resets.

    :param steps: environment steps of training
    :param seed: seed
    :param n_episodes: episodes to test on; one succeeds if the goal is reached at any step
    :return: what goes into the file
    """
    th.set_num_threads(1)
    gym.register_envs(gymnasium_robotics)
    env = gym.make("FetchReach-v4")
    agent = SkillGraphAgent("MultiInputPolicy", env, seed=seed)
    start = time.perf_counter()
    agent.learn(steps)
    seconds = time.perf_counter() - start
    successes = []
    for episode in range(n_episodes):
        observation, _ = env.reset(seed=10_000 * (seed + 1) + episode)
        state, over, success = None, False, False
        while not over:
            action, state = agent.predict(observation, state, deterministic=True)
            observation, _, terminated, truncated, info = env.step(action)
            success = success or bool(info["is_success"])
            over = terminated or truncated
        successes.append(success)
    graph = {name: round(value, 3) for name, value in agent.graph_summary().items()}
    return {"seed": seed, "success_rate": float(np.mean(successes)), "train_seconds": round(seconds, 1), "graph": graph}


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=30_000)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--episodes", type=int, default=50)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--out", type=pathlib.Path, required=True)
    args = parser.parse_args()
    runs = Parallel(n_jobs=args.jobs)(delayed(run_seed)(args.steps, seed, args.episodes) for seed in args.seeds)
    command = "python -m benchmarks.fetch_reach " + shlex.join(sys.argv[1:])
    mean = float(np.mean([run["success_rate"] for run in runs]))
    document = {"command": command, "version": __version__, "mean": mean, "runs": runs}
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(json.dumps(document, indent=1) + "\n")
    print(json.dumps(document, indent=1))


if __name__ == "__main__":
    main()
