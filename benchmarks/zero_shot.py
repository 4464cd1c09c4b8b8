"""Zero-shot success on random pairs of start and goal, and what plans promised, several seeds (section 4.2).

    python -m benchmarks.zero_shot --env SkillGraph/PointMazeMedium-v0 --checks 5000 10000 20000 \
        --out benchmarks/results/zero_shot_medium.json

Each seed trains an agent, as ``hyperparams/skillgraph.yml`` recommends, and tests it on 100 pairs after each number of
steps; at the end the same walker goes straight on to the same goals. The file holds every seed as it came out, means with
standard errors and 95 % t intervals over seeds, and the promises of all plans beside what happened.
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
from sb3_skillgraph.baselines import StraightOn
from sb3_skillgraph.envs import find
from sb3_skillgraph.evaluation import PairsResult, brier_score, calibration
from sb3_skillgraph.hyperparams import check_hyperparams, load_hyperparams


def run_seed(args: argparse.Namespace, seed: int) -> dict[str, Any]:
    """Train and test one agent.

    :param args: the command line
    :param seed: seed of the agent; pairs are drawn with ``seed + 1000``
    :return: what goes into the file
    """
    th.set_num_threads(1)
    find(args.env)
    env = gym.make(args.env, **args.env_kwargs)
    settings = {**load_hyperparams(args.env), **check_hyperparams(args.arguments, "--arguments")}
    del settings["n_timesteps"]
    agent = SkillGraphAgent(env=env, seed=seed, **settings)
    checks = []
    for n_steps in args.checks:
        begin = time.perf_counter()
        agent.learn(n_steps - agent.num_timesteps, reset_num_timesteps=False, log_interval=None)
        seconds = time.perf_counter() - begin
        result = evaluate_pairs(agent, args.env, env_kwargs=args.env_kwargs, n_pairs=args.pairs, seed=seed + 1000)
        graph = {name: round(value, 3) for name, value in agent.graph_summary().items()}
        checks.append({"steps": n_steps, "train_seconds": round(seconds, 1), **described(result), "graph": graph})
    if agent.rules is not None:
        return {"seed": seed, "checks": checks}  # its walker does not learn
    straight = evaluate_pairs(StraightOn(agent), args.env, env_kwargs=args.env_kwargs, n_pairs=args.pairs, seed=seed + 1000)
    pairs = [[int(pair.success), pair.steps] for pair in straight.pairs]
    return {"seed": seed, "checks": checks, "straight_on": {"success_rate": straight.success_rate, "pairs": pairs}}


def described(result: PairsResult) -> dict[str, Any]:
    """Return what is kept of a test: rates, the episodes in which the agent fell, and each pair's success, steps, promise."""
    steps = [pair.steps for pair in result.pairs if pair.success]
    long_direct = sum(trace.direct_steps for trace in result.traces) / sum(pair.steps for pair in result.pairs)
    return {
        "success_rate": result.success_rate,
        "mean_steps": round(float(np.mean(steps)), 1) if steps else None,
        "walk_success_rate": round(result.option_success_rate, 3),
        "direct_share": round(long_direct, 3),
        "fell": sum(pair.stuck for pair in result.pairs),
        "pairs": [[int(pair.success), pair.steps, round(pair.trace.promised, 3)] for pair in result.pairs if pair.trace],
    }


def steps_over_straight_on(run: dict[str, Any]) -> float:
    """Return the steps of the trained agent over those of the walker sent straight on, over the pairs that both reached."""
    both = [
        (a[1], b[1]) for a, b in zip(run["checks"][-1]["pairs"], run["straight_on"]["pairs"], strict=True) if a[0] and b[0]
    ]
    ours, straight = np.sum(both, axis=0) if both else (np.nan, np.nan)
    return float(ours / straight)


def promises(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """Compare what the plans of all seeds and checks promised with what happened."""
    plans = [(pair[2], bool(pair[0])) for run in runs for check in run["checks"] for pair in check["pairs"]]
    rate = float(np.mean([success for _, success in plans]))
    bins = [
        {**bin._asdict(), "promised": round(bin.promised, 3), "observed": round(bin.observed, 3)} for bin in calibration(plans)
    ]
    return {"bins": bins, "brier": round(brier_score(plans), 4), "brier_of_the_mean": round(rate * (1.0 - rate), 4)}


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
    parser.add_argument("--checks", type=int, nargs="+", default=[5_000, 10_000, 20_000], help="steps after which to test")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--pairs", type=int, default=100)
    parser.add_argument("--arguments", type=json.loads, default={}, help='JSON, such as {"rules": "paper"}')
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--out", type=pathlib.Path, required=True)
    args = parser.parse_args()
    runs = []
    jobs = (delayed(run_seed)(args, seed) for seed in args.seeds)
    for run in Parallel(n_jobs=args.jobs, return_as="generator")(jobs):
        runs.append(run)
        for check in run["checks"]:
            print(json.dumps({"seed": run["seed"], **{k: v for k, v in check.items() if k != "pairs"}}), flush=True)
        document: dict[str, Any] = {
            "command": "python -m benchmarks.zero_shot " + shlex.join(sys.argv[1:]),
            "version": __version__,
            "success_rate": {
                check["steps"]: summary([r["checks"][i]["success_rate"] for r in runs])
                for i, check in enumerate(run["checks"])
            },
            "promises": promises(runs),
            "runs": runs,
        }
        if "straight_on" in run:
            document["straight_on"] = summary([r["straight_on"]["success_rate"] for r in runs])
            document["steps_over_straight_on"] = round(float(np.mean([steps_over_straight_on(r) for r in runs])), 3)
        args.out.parent.mkdir(parents=True, exist_ok=True)
        args.out.write_text(json.dumps(document) + "\n")
    print(json.dumps({name: value for name, value in document.items() if name != "runs"}, indent=1))


if __name__ == "__main__":
    main()
