"""OGBench's mazes, learned online, without reward, from one fixed start: its tasks, and random pairs.

    python -m benchmarks.ogbench --maze giant --checks 50000 100000 200000 --out benchmarks/results/ogbench_giant.json

Each seed trains an agent (episodes of 1000 steps, all from the cell (1, 1)), and after each number of steps tests it on
OGBench's five tasks, start and goal drawn around their cells as there, and on random pairs two or more cells apart. The
steps to the goals of the pairs are set against the shortest possible: king moves of 0.2 on a grid, for a body that keeps
0.7 from walls, up to where the goal counts as reached.
"""

import argparse
import json
import pathlib
import shlex
import sys
import time
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from joblib import Parallel, delayed
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from benchmarks.zero_shot import promises, summary
from sb3_skillgraph import SkillGraphAgent, __version__
from sb3_skillgraph.envs import MazeGeometry
from sb3_skillgraph.evaluation import PairResult, run_pair, sample_pairs

STEP, BODY = 0.2, 0.7  # what an action of 1 moves the point, and what it keeps from walls, in world units


class Shortest:
    """The fewest steps from one place to another.

    :param geometry: the maze
    :param radius: distance within which a goal counts as reached, in world units
    """

    def __init__(self, geometry: MazeGeometry, radius: float) -> None:
        left, right, bottom, top = geometry.extent
        self.corner = np.array([left, bottom])
        xs, ys = np.arange(left, right, STEP), np.arange(bottom, top, STEP)
        self.grid = np.stack(np.meshgrid(xs, ys, indexing="ij"), axis=-1)
        self.free = np.array([[geometry.has_room(x, y, BODY) for y in ys] for x in xs])
        self.radius = radius

    def __call__(self, start: NDArray[np.float64], goal: NDArray[np.float64]) -> int:
        """Return the number of moves.

        :param start: shape (2,)
        :param goal: shape (2,)
        """
        seen = (np.linalg.norm(self.grid - goal, axis=-1) <= self.radius) & self.free
        # The free place of the grid nearest to the start.
        distance = np.where(self.free, np.linalg.norm(self.grid - start, axis=-1), np.inf)
        here = np.unravel_index(distance.argmin(), distance.shape)
        for n_moves in range(10_000):
            if seen[here]:
                return n_moves
            seen = binary_dilation(seen, np.ones((3, 3))) & self.free
        raise ValueError("No way leads there.")


def run_seed(args: argparse.Namespace, seed: int) -> dict[str, Any]:
    """Train and test one agent."""
    th.set_num_threads(1)
    id = f"SkillGraph/OGBenchPoint{args.maze.capitalize()}-v0"
    agent = SkillGraphAgent("MultiInputPolicy", gym.make(id), seed=seed, **args.arguments)
    env = gym.make(id)
    geometry: MazeGeometry = env.get_wrapper_attr("geometry")
    rng = np.random.default_rng(seed)
    tasks = [
        [(start + rng.uniform(-1, 1, 2), goal + rng.uniform(-1, 1, 2)) for _ in range(args.episodes)]
        for start, goal in env.get_wrapper_attr("tasks")
    ]
    pairs = sample_pairs(geometry, env.get_wrapper_attr("body_radius"), args.pairs, seed + 1000)
    shortest = Shortest(geometry, env.get_wrapper_attr("success_radius"))
    fewest = np.array([shortest(start, goal) for start, goal, _ in pairs])
    checks = []
    for n_steps in args.checks:
        begin = time.perf_counter()
        agent.learn(n_steps - agent.num_timesteps, reset_num_timesteps=False, log_interval=None)
        seconds = time.perf_counter() - begin
        env.reset(seed=seed)
        official = [[run_pair(agent, env, start, goal, np.nan) for start, goal in task] for task in tasks]
        random = [run_pair(agent, env, start, goal, cells) for start, goal, cells in pairs]
        reached = np.array([pair.success for pair in random])
        steps = np.array([pair.steps for pair in random])
        checks.append(
            {
                "steps": n_steps,
                "train_seconds": round(seconds, 1),
                "official": float(np.mean([pair.success for task in official for pair in task])),
                "by_task": [float(np.mean([pair.success for pair in task])) for task in official],
                "random_pairs": float(reached.mean()),
                "mean_steps": round(float(steps[reached].mean()), 1) if reached.any() else None,
                "times_shortest": round(float(steps[reached].sum() / fewest[reached].sum()), 3) if reached.any() else None,
                "events": len(agent.events),
                "edges": agent.graph.edges.size,
                "pairs": kept([*random, *(pair for task in official for pair in task)]),
            }
        )
    return {"seed": seed, "checks": checks}


def kept(pairs: list[PairResult]) -> list[list[float]]:
    """Return of each pair its success, its steps and what was promised."""
    return [[int(pair.success), pair.steps, round(pair.trace.promised, 3)] for pair in pairs if pair.trace]


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--maze", choices=("medium", "large", "giant", "teleport"), default="giant")
    parser.add_argument("--checks", type=int, nargs="+", default=[50_000, 100_000, 200_000], help="steps after which to test")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--pairs", type=int, default=100, help="random pairs of start and goal")
    parser.add_argument("--episodes", type=int, default=20, help="of each of OGBench's tasks")
    parser.add_argument("--arguments", type=json.loads, default={}, help="JSON, arguments of the agent")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--out", type=pathlib.Path, required=True)
    args = parser.parse_args()
    runs = []
    for run in Parallel(n_jobs=args.jobs, return_as="generator")(delayed(run_seed)(args, seed) for seed in args.seeds):
        runs.append(run)
        for check in run["checks"]:
            print(json.dumps({"seed": run["seed"], **{k: v for k, v in check.items() if k != "pairs"}}), flush=True)
        document = {
            "command": "python -m benchmarks.ogbench " + shlex.join(sys.argv[1:]),
            "version": __version__,
            **{
                name: {c["steps"]: summary([r["checks"][i][name] for r in runs]) for i, c in enumerate(run["checks"])}
                for name in ("official", "random_pairs")
            },
            "promises": promises(runs),
            "runs": runs,
        }
        args.out.parent.mkdir(parents=True, exist_ok=True)
        args.out.write_text(json.dumps(document) + "\n")


if __name__ == "__main__":
    main()
