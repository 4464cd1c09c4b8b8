"""Few-shot adaptation: goals behind a door that opens after training (section 3.3).

    python -m benchmarks.few_shot --seeds 0 1 2

Each seed trains an agent in a maze whose right half is shut off. Then the door opens. For each of some goals behind it a
copy of the agent adapts, a few thousand environment steps at a time, always from the start it was trained from; after
each stretch it is tested from random starts in the old half. Every copy is tested on old pairs as well: adapting must not
cost what was known.
"""

import argparse
import json
import pathlib
import shlex
import sys
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from joblib import Parallel, delayed
from stable_baselines3.common.type_aliases import PolicyPredictor

from benchmarks.collect import RESULTS, Row, write
from sb3_skillgraph import SkillGraphAgent, __version__
from sb3_skillgraph.envs import MazeGeometry, MazeMap
from sb3_skillgraph.evaluation import run_pair
from sb3_skillgraph.experiments.console import commit

ENV = "SkillGraph/PointMaze-v0"
DOOR = (4, 4)
OPENED: MazeMap = [
    [1, 1, 1, 1, 1, 1, 1, 1, 1],
    [1, "r", 0, 0, 1, 0, 0, 0, 1],
    [1, 0, 1, 0, 1, 0, 1, 0, 1],
    [1, 0, 1, 0, 1, 0, 1, 0, 1],
    [1, 0, 1, 0, 0, 0, 1, 0, 1],
    [1, 0, 0, 0, 1, 0, 0, 0, 1],
    [1, 1, 1, 1, 1, 1, 1, 1, 1],
]
SHUT: MazeMap = [[1 if (i, j) == DOOR else cell for j, cell in enumerate(row)] for i, row in enumerate(OPENED)]
MIN_CELLS = 2.0  # between a start and its goal


class Halves:
    """Draws points on either side of the door.

    :param env: the maze with the door open
    :param seed: seed of the points
    """

    def __init__(self, env: gym.Env, seed: int) -> None:
        self.geometry: MazeGeometry = env.get_wrapper_attr("geometry")
        self.margin: float = env.get_wrapper_attr("body_radius")
        self.rng = np.random.default_rng(seed)

    def point(self, behind: bool) -> np.ndarray:
        """Return a random free point, half a cell or more away from the door's column."""
        while True:
            point = self.geometry.sample_free(self.rng, self.margin)
            if abs(point[0]) > 0.5 * self.geometry.cell_size and (point[0] > 0) == behind:
                return point

    def pair(self) -> tuple[np.ndarray, np.ndarray]:
        """Return an old start and goal."""
        while True:
            start, goal = self.point(False), self.point(False)
            if self.geometry.shortest_path_length(start, goal) >= MIN_CELLS * self.geometry.cell_size:
                return start, goal


def success(agent: PolicyPredictor, env: gym.Env, pairs: list[tuple[np.ndarray, np.ndarray]]) -> float:
    """Return the share of pairs of start and goal between which the agent finds its way."""
    return float(np.mean([run_pair(agent, env, start, goal, np.nan).success for start, goal in pairs]))


def run_seed(args: argparse.Namespace, seed: int) -> dict[str, Any]:
    """Train an agent behind the shut door, and let copies of it adapt once it is open."""
    th.set_num_threads(1)
    agent = SkillGraphAgent("MultiInputPolicy", gym.make(ENV, maze_map=SHUT), seed=seed)
    agent.learn(args.steps, log_interval=None)
    env = gym.make(ENV, maze_map=OPENED)
    env.reset(seed=seed)
    halves = Halves(env, seed + 1000)
    old = [halves.pair() for _ in range(args.old_pairs)]
    goals = []
    for _ in range(args.goals):
        goal = halves.point(True)
        pairs = [(halves.point(False), goal) for _ in range(args.starts)]
        copy = agent.copy(gym.make(ENV, maze_map=OPENED))
        curve = [success(copy, env, pairs)]
        for _ in range(args.total, 0, -args.stretch):
            copy.adapt(goal, total_timesteps=args.stretch)
            curve.append(success(copy, env, pairs))
        goals.append({"goal": goal.round(3).tolist(), "curve": curve, "old": success(copy, env, old)})
    curves = np.mean([goal["curve"] for goal in goals], axis=0)
    after = float(np.mean([goal["old"] for goal in goals]))
    return {
        "seed": seed,
        "curve": curves.round(4).tolist(),
        "old_before": success(agent, env, old),
        "old_after": after,
        "goals": goals,
    }


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=60_000, help="environment steps of training")
    parser.add_argument("--total", type=int, default=10_000, help="environment steps of adaptation")
    parser.add_argument("--stretch", type=int, default=2_500, help="environment steps between tests")
    parser.add_argument("--goals", type=int, default=10, help="goals behind the door, a seed")
    parser.add_argument("--starts", type=int, default=10, help="random starts a goal")
    parser.add_argument("--old-pairs", type=int, default=50)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--out", type=pathlib.Path, default=RESULTS / "few_shot", help="folder of the table")
    args = parser.parse_args()
    runs = Parallel(n_jobs=args.jobs, return_as="generator")(delayed(run_seed)(args, seed) for seed in args.seeds)
    rows: list[Row] = []
    for run in runs:
        print(json.dumps({name: run[name] for name in ("seed", "curve", "old_before", "old_after")}), flush=True)
        for i, rate in enumerate(run["curve"]):
            row = {"seed": run["seed"], "steps": args.steps, "extra_steps": i * args.stretch, "success_rate": rate}
            old = {"old_pairs_before": run["old_before"], "old_pairs_after": run["old_after"]}
            rows.append({**row, **old, "version": __version__, "commit": commit()})
    args.out.mkdir(parents=True, exist_ok=True)
    write(args.out / "runs.csv", rows)
    (args.out / "command.txt").write_text("python -m benchmarks.few_shot " + shlex.join(sys.argv[1:]) + "\n")


if __name__ == "__main__":
    main()
