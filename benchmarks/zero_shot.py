"""Zero-shot success on random pairs of start and goal, several seeds (section 4.2).

    python -m benchmarks.zero_shot --env SkillGraph/PointMazeMedium-v0 --steps 100000 --seeds 0 1 2 \
        --out benchmarks/results/zero_shot_medium.json

Each seed trains an agent, then tests it on 100 pairs with planning on and, on the same pairs, off (the global option
walks straight to the goal). The file holds every seed as it came out, and the mean with a 95 % t interval over seeds.
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
from scipy import stats

from sb3_skillgraph import SkillGraphAgent, __version__, evaluate_pairs


def run_seed(env_id: str, env_kwargs: dict[str, Any], steps: int, seed: int, n_pairs: int, arguments: dict[str, Any]) -> Any:
    """Train and test one agent.

    :param env_id: id of a maze environment
    :param env_kwargs: its keyword arguments
    :param steps: environment steps of training
    :param seed: seed of the agent; pairs are drawn with ``seed + 1000``
    :param n_pairs: pairs to test on
    :param arguments: arguments of the agent that differ from the defaults
    :return: what goes into the file
    """
    th.set_num_threads(1)
    env = gym.make(env_id, **env_kwargs)
    agent = SkillGraphAgent("MultiInputPolicy", env, seed=seed, **arguments)
    start = time.perf_counter()
    agent.learn(steps)
    seconds = time.perf_counter() - start
    result = evaluate_pairs(agent, env_id, env_kwargs=env_kwargs, n_pairs=n_pairs, seed=seed + 1000)
    agent.planning = False
    straight = evaluate_pairs(agent, env_id, env_kwargs=env_kwargs, n_pairs=n_pairs, seed=seed + 1000)
    return {
        "seed": seed,
        "success_rate": result.success_rate,
        "interval": result.interval,
        "success_rate_planning_off": straight.success_rate,
        "mean_steps": float(np.mean([pair.steps for pair in result.pairs])),
        "train_seconds": round(seconds, 1),
        "graph": {name: round(value, 3) for name, value in agent.graph_summary().items()},
        "by_path_length": by_path_length(result.pairs),
    }


def by_path_length(pairs: list[Any]) -> dict[str, list[float]]:
    """Bin success by the length of the shortest path: ``"2-4 cells": [rate, number of pairs]``."""
    bins: dict[str, list[float]] = {}
    for low in range(2, 20, 3):
        hits = [pair.success for pair in pairs if low <= pair.path_length < low + 3]
        if hits:
            bins[f"{low}-{low + 3} cells"] = [float(np.mean(hits)), len(hits)]
    return bins


def summary(rates: list[float]) -> dict[str, Any]:
    """Return the mean of the seeds' rates, its standard error and a 95 % t interval."""
    mean, error = float(np.mean(rates)), float(stats.sem(rates)) if len(rates) > 1 else float("nan")
    half = float(stats.t.ppf(0.975, len(rates) - 1)) * error if len(rates) > 1 else float("nan")
    return {"mean": mean, "standard_error": error, "interval": [max(0.0, mean - half), min(1.0, mean + half)]}


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="SkillGraph/PointMazeMedium-v0")
    parser.add_argument("--env-kwargs", type=json.loads, default={}, help='JSON, such as {"maze_map": [[1, ...], ...]}')
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--pairs", type=int, default=100)
    parser.add_argument("--arguments", type=json.loads, default={}, help="JSON, arguments of the agent")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--out", type=pathlib.Path, required=True)
    args = parser.parse_args()
    runs = []
    jobs = (delayed(run_seed)(args.env, args.env_kwargs, args.steps, seed, args.pairs, args.arguments) for seed in args.seeds)
    for run in Parallel(n_jobs=args.jobs, return_as="generator")(jobs):
        runs.append(run)
        print(json.dumps({name: run[name] for name in ("seed", "success_rate", "success_rate_planning_off", "train_seconds")}))
        document = {
            "command": "python -m benchmarks.zero_shot " + shlex.join(sys.argv[1:]),
            "version": __version__,
            "success_rate": summary([r["success_rate"] for r in runs]),
            "success_rate_planning_off": summary([r["success_rate_planning_off"] for r in runs]),
            "runs": runs,
        }
        args.out.parent.mkdir(parents=True, exist_ok=True)
        args.out.write_text(json.dumps(document, indent=1) + "\n")
    print(json.dumps({name: document[name] for name in ("success_rate", "success_rate_planning_off")}, indent=1))


if __name__ == "__main__":
    main()
