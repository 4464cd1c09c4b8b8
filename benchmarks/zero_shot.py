"""Zero-shot success on random pairs of start and goal, several seeds (section 4.2).

    python -m benchmarks.zero_shot --env SkillGraph/PointMazeMedium-v0 --steps 100000 --seeds 0 1 2 3 4 \
        --out benchmarks/results/zero_shot_medium.json

Each seed trains an agent, then tests it on 100 pairs with planning on and, on the same pairs, off (the global option
walks straight to the goal); then with planning on at the paper's tolerance (0.2 of a cell). ``--checks 100000 20000``
tests on the way, too: from 100 000 steps on every 20 000. The file holds every seed as it came out, and means with
standard errors and 95 % t intervals over seeds; plans' predicted success against what became of them is pooled.
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
from sb3_skillgraph.evaluation import PairsResult

TOLERANCE = 0.2  # the paper's, in cells
RATES = ("success_rate", "success_rate_close", "success_rate_planning_off", "planned_share", "option_success_rate")


def run_seed(args: argparse.Namespace, seed: int) -> dict[str, Any]:
    """Train and test one agent.

    :param args: the command line
    :param seed: seed of the agent; pairs are drawn with ``seed + 1000``
    :return: what goes into the file
    """
    th.set_num_threads(1)
    env = gym.make(args.env, **args.env_kwargs)
    agent = SkillGraphAgent("MultiInputPolicy", env, seed=seed, **args.arguments)
    first, every = args.checks or (args.steps, 1)
    seconds, checks = 0.0, []
    for n_steps in [*range(first, args.steps, every), args.steps]:
        start = time.perf_counter()
        agent.learn(n_steps - agent.num_timesteps, reset_num_timesteps=False, log_interval=None)
        seconds += time.perf_counter() - start
        if n_steps < args.steps:
            checks.append([n_steps, tested(agent, args, seed).success_rate])
    result = tested(agent, args, seed)
    close = tested(agent, args, seed, success_radius=TOLERANCE)
    agent.planning = False
    straight = tested(agent, args, seed)
    if args.keep is not None:
        args.keep.mkdir(parents=True, exist_ok=True)
        agent.save(args.keep / f"{args.out.stem}_{seed}.zip")
    return {
        "seed": seed,
        "success_rate": result.success_rate,
        "interval": result.interval,
        "success_rate_close": close.success_rate,
        "success_rate_planning_off": straight.success_rate,
        "checks": [*checks, [args.steps, result.success_rate]],
        "mean_steps": float(np.mean([pair.steps for pair in result.pairs])),
        "planned_share": round(result.planned_share, 3),
        "option_success_rate": round(result.option_success_rate, 3),
        "train_seconds": round(seconds, 1),
        "graph": {name: round(value, 3) for name, value in agent.graph_summary().items()},
        "by_path_length": by_path_length(result.pairs),
        "pairs": {
            "planning_on": [int(pair.success) for pair in result.pairs],
            "planning_off": [int(pair.success) for pair in straight.pairs],
        },
        "plans": [[round(t.predicted, 3), int(bool(t.followed))] for t in result.traces if t.predicted is not None],
    }


def tested(agent: SkillGraphAgent, args: argparse.Namespace, seed: int, **env_kwargs: Any) -> PairsResult:
    """Test an agent on its seed's pairs."""
    kwargs = {**args.env_kwargs, **env_kwargs}
    return evaluate_pairs(agent, args.env, env_kwargs=kwargs, n_pairs=args.pairs, seed=seed + 1000)


def calibration(runs: list[dict[str, Any]], n_bins: int = 5) -> list[dict[str, float]]:
    """Compare what the plans of all seeds promised with what became of them, in equally wide bins."""
    plans = [plan for run in runs for plan in run["plans"]]
    bins = []
    for i in range(n_bins):
        inside = [plan for plan in plans if min(int(plan[0] * n_bins), n_bins - 1) == i]
        if inside:
            predicted, observed = np.mean(inside, axis=0).round(3).tolist()
            bins.append({"low": i / n_bins, "plans": len(inside), "predicted": predicted, "observed": observed})
    return bins


def by_path_length(pairs: list[Any]) -> dict[str, list[float]]:
    """Bin success by the length of the shortest path: ``"2-4 cells": [rate, number of pairs]``."""
    bins: dict[str, list[float]] = {}
    for low in range(2, 20, 3):
        hits = [pair.success for pair in pairs if low <= pair.path_length < low + 3]
        if hits:
            bins[f"{low}-{low + 3} cells"] = [float(np.mean(hits)), len(hits)]
    return bins


def summary(rates: list[float], lowest: float = 0.0) -> dict[str, Any]:
    """Return the mean of the seeds' rates (or their differences, which may be negative), standard error, 95 % t interval."""
    mean, error = float(np.mean(rates)), float(stats.sem(rates)) if len(rates) > 1 else float("nan")
    half = float(stats.t.ppf(0.975, len(rates) - 1)) * error if len(rates) > 1 else float("nan")
    return {"mean": mean, "standard_error": error, "interval": [max(lowest, mean - half), min(1.0, mean + half)]}


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="SkillGraph/PointMazeMedium-v0")
    parser.add_argument("--env-kwargs", type=json.loads, default={}, help='JSON, such as {"maze_map": [[1, ...], ...]}')
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--pairs", type=int, default=100)
    parser.add_argument("--arguments", type=json.loads, default={}, help="JSON, arguments of the agent")
    parser.add_argument("--checks", type=int, nargs=2, metavar=("FIRST", "EVERY"), help="steps at which to test on the way")
    parser.add_argument("--keep", type=pathlib.Path, help="folder for the trained agents")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--out", type=pathlib.Path, required=True)
    args = parser.parse_args()
    runs = []
    jobs = (delayed(run_seed)(args, seed) for seed in args.seeds)
    for run in Parallel(n_jobs=args.jobs, return_as="generator")(jobs):
        runs.append(run)
        print(json.dumps({name: run[name] for name in ("seed", *RATES, "train_seconds")}), flush=True)
        document = {
            "command": "python -m benchmarks.zero_shot " + shlex.join(sys.argv[1:]),
            "version": __version__,
            **{name: summary([r[name] for r in runs]) for name in RATES},
            "planning_on_minus_off": summary([r["success_rate"] - r["success_rate_planning_off"] for r in runs], lowest=-1.0),
            "calibration": calibration(runs),
            "runs": runs,
        }
        args.out.parent.mkdir(parents=True, exist_ok=True)
        args.out.write_text(json.dumps(document, indent=1) + "\n")
    print(json.dumps({name: document[name] for name in (*RATES, "planning_on_minus_off", "calibration")}, indent=1))


if __name__ == "__main__":
    main()
