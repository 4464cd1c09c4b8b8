"""Each default switched off by itself, and the paper as written, against the defaults.

    python -m benchmarks.ablation --env SkillGraph/PointMazeMedium-v0 --steps 100000 --seeds 0 1 2 \
        --out benchmarks/results/ablation_medium

One file per variant lands in the folder; a variant whose file is there is not run again. ``--table`` prints the folder as a
Markdown table instead: success, its difference from the defaults on the same seeds, and what else tells variants apart,
success after half of the steps above all: in the end most variants get there.
"""

import argparse
import json
import pathlib
import shlex
import sys
from typing import Any

import numpy as np
from joblib import Parallel, delayed

from benchmarks.zero_shot import RATES, calibration, run_seed, summary
from sb3_skillgraph import PAPER, __version__

#: Name of a variant -> arguments that differ from the defaults.
VARIANTS: dict[str, dict[str, Any]] = {
    "defaults": {},
    "paper": PAPER,
    "no global option to start from": {"warm_start": False},
    "saturated actors": {"saturation_penalty": 0.0},
    "no hindsight": {"hindsight": 0.0},
    "own experience only": {"shared_experience": 0.0},
    "goals as wide as events": {"goal_tolerance": 1.0},
    "three successes to mature": {"gestation_period": 3},
    "no runs of its own to complete": {"practice_runs": 0},
    "uniform random events (oracle)": {"salience": "rrt"},
    "events in pairs": {"events_per_attempt": 2},
    "no limit of unconnected events": {"max_unconnected": None},
    "ten episodes to the next attempt": {"retry_after": 10},
    "uniform targets": {"target_choice": "uniform"},
    "no exploration": {"explore_prob": 0.0},
    "no practice": {"practise_prob": 0.0},
    "random practice": {"practise": "random"},
    "hopeless chains kept": {"max_failures": None},
    "chains from the nearest vertex only": {"link_reach": 0},
    "own runs only": {"off_policy_runs": False},
    "nothing pruned": {"prune_after": None},
    "strict containment": {"containment": 1.0},
    "no edges from evidence": {"evidence_edges": False},
    "plain success rates": {"rate_prior": [0.0, 0.0], "min_success_rate": 0.0},
    "a failure costs one run": {"failure_cost": 1.0},
    "Euclidean nearest vertex": {"nearest": "euclidean"},
    "no end to standing still": {"stall_steps": None},
    "no random actions": {"random_action_prob": 0.0},
}


def file_of(folder: pathlib.Path, name: str) -> pathlib.Path:
    """Return where a variant's results are."""
    return folder / f"{name.replace(' ', '_').replace('(', '').replace(')', '')}.json"


def collect(args: argparse.Namespace, name: str, runs: list[dict[str, Any]]) -> None:
    """Write what a variant's seeds gave."""
    for run in runs:
        del run["pairs"]
    document: dict[str, Any] = {
        "command": "python -m benchmarks.ablation " + shlex.join(sys.argv[1:]),
        "version": __version__,
        "variant": name,
        "arguments": VARIANTS[name],
        **{rate: summary([run[rate] for run in runs]) for rate in RATES},
        "calibration": calibration(runs),
        "runs": runs,
    }
    args.out.mkdir(parents=True, exist_ok=True)
    file_of(args.out, name).write_text(json.dumps(document, indent=1) + "\n")
    rates = ", ".join(f"{run['success_rate']:.2f}" for run in runs)
    print(f"{name}: {document['success_rate']['mean']:.3f} ({rates})", flush=True)


def table(folder: pathlib.Path) -> str:
    """Return a folder's results as a Markdown table, the defaults first, then by success."""
    documents = {name: json.loads(file_of(folder, name).read_text()) for name in VARIANTS if file_of(folder, name).exists()}
    base = documents["defaults"]["runs"]
    columns = ["Variant", "Arguments", "Success", "Against the defaults", "After half of the steps", "At 0.2 of a cell"]
    columns += ["Steps to the goal", "Options that succeed", "Options"]
    lines = [f"| {' | '.join(columns)} |", "|---" * len(columns) + "|"]
    for name, document in sorted(
        documents.items(), key=lambda item: (item[0] != "defaults", -item[1]["success_rate"]["mean"])
    ):
        runs = document["runs"]
        differences = [run["success_rate"] - other["success_rate"] for run, other in zip(runs, base, strict=True)]
        arguments = (
            ", ".join(f"`{key}={value}`" for key, value in document["arguments"].items()) if name != "paper" else "`**PAPER`"
        )
        rates = ", ".join(f"{run['success_rate']:.2f}" for run in runs)
        cells = [
            name,
            arguments,
            f"{document['success_rate']['mean']:.3f} ({rates})",
            f"{np.mean(differences):+.3f}",
            f"{np.mean([run['checks'][0][1] for run in runs]):.3f}",
            f"{document['success_rate_close']['mean']:.3f}",
            f"{np.mean([run['mean_steps'] for run in runs]):.0f}",
            f"{document['option_success_rate']['mean']:.2f}",
            f"{np.mean([run['graph']['options'] for run in runs]):.0f}",
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def main() -> None:
    """Run the benchmark, or print its table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="SkillGraph/PointMazeMedium-v0")
    parser.add_argument("--env-kwargs", type=json.loads, default={})
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--pairs", type=int, default=100)
    parser.add_argument("--variants", nargs="+", choices=list(VARIANTS), default=list(VARIANTS))
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--table", action="store_true", help="print the folder as a table")
    parser.add_argument("--out", type=pathlib.Path, required=True, help="folder")
    args = parser.parse_args()
    if args.table:
        print(table(args.out))
        return
    args.checks, args.keep = (args.steps // 2, args.steps), None
    names = [name for name in args.variants if not file_of(args.out, name).exists()]
    jobs = [
        (name, argparse.Namespace(**{**vars(args), "arguments": VARIANTS[name]}), seed)
        for name in names
        for seed in args.seeds
    ]
    runs: dict[str, list[dict[str, Any]]] = {name: [] for name in names}
    results = Parallel(n_jobs=args.jobs, return_as="generator")(
        delayed(run_seed)(job_args, seed) for _, job_args, seed in jobs
    )
    for (name, _, _), run in zip(jobs, results, strict=True):
        runs[name].append(run)
        if len(runs[name]) == len(args.seeds):
            collect(args, name, runs[name])


if __name__ == "__main__":
    main()
