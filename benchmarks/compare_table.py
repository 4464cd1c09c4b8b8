"""Sum up the finished runs of a plan: two CSVs, and the README's tables: every method, and the order that the paper reports.

python -m benchmarks.compare_table benchmarks/compare.yml benchmarks/results/compare
"""

import argparse
import csv
import math
import pathlib
import warnings
from typing import Any

import numpy as np
from scipy.stats import ttest_ind

from sb3_skillgraph.experiments.plan import load_plan
from sb3_skillgraph.experiments.run_folder import DONE, read_json
from sb3_skillgraph.experiments.runner import RunStatus, by_method, status
from sb3_skillgraph.experiments.summary import estimate

# What Figure 5 of the paper shows, and what it leaves open: is it the planning, or hindsight, or events?
ORDER = [
    ("dsg-rrt", "dsg-dco"),
    ("dsg-dco", "uvfa"),
    ("dsg-dco", "dco-10"),
    ("dsg-frontier", "dsg-rrt"),
    ("dsg-frontier", "ddpg-her"),
    ("dsg-frontier", "td3-her-recipe"),
    ("dsg-frontier", "td3-her-recipe-body"),
    ("dsg-frontier", "straight-on"),
    ("dco-10", "random-walk"),
]


def steps_to_goals(runs: list[RunStatus], out: pathlib.Path) -> float:
    """Return how many environment steps the goals that were reached took, in the mean; no number if none was."""
    documents = [read_json(run.spec.folder(out) / DONE) for run in runs]
    steps = [pair["steps"] for document in documents for pair in document["pairs"] if pair["success"]]
    return float(np.mean(steps)) if steps else math.nan


def summarise(groups: dict[tuple[str, str], list[RunStatus]], out: pathlib.Path) -> list[dict[str, Any]]:
    """Return a row for every method on every environment that has a finished run, the best first."""
    rows = []
    for (environment, method), runs in groups.items():
        scores = np.array([run.success_rate for run in runs])
        iqm, low, high = estimate(scores[None])
        rows.append(
            {
                "environment": environment,
                "method": method,
                "steps": runs[0].spec.steps,
                "seeds": len(scores),
                "mean": scores.mean(),
                "iqm": iqm,
                "low": low,
                "high": high,
                "worst": scores.min(),
                "best": scores.max(),
                "steps_to_goals_reached": steps_to_goals(runs, out),
            }
        )
    order = list(dict.fromkeys(row["environment"] for row in rows))
    return sorted(rows, key=lambda row: (order.index(row["environment"]), -row["mean"]))


def compare(groups: dict[tuple[str, str], list[RunStatus]]) -> list[dict[str, Any]]:
    """Return a row for every pair of methods whose order is asked for: the difference of means with Welch's 95 % interval."""
    scores = {key: np.array([run.success_rate for run in runs]) for key, runs in groups.items()}
    rows = []
    for environment in dict.fromkeys(environment for environment, _ in scores):
        for better, worse in ORDER:
            a, b = (scores.get((environment, method), np.empty(0)) for method in (better, worse))
            if min(len(a), len(b)) < 2:
                continue
            difference = low = high = float(np.mean(a) - np.mean(b))
            if np.ptp(a) or np.ptp(b):
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore", RuntimeWarning)  # that all seeds of one of them agree
                    low, high = ttest_ind(a, b, equal_var=False).confidence_interval()
            row = dict(environment=environment, better=better, worse=worse, difference=difference, low=low, high=high)
            rows.append({**row, "seeds": f"{len(a)}, {len(b)}"})
    return rows


def compared_line(row: dict[str, Any]) -> str:
    """Return a row of the second table in Markdown."""
    numbers = f"{row['difference']:+.3f} ({row['low']:+.3f} to {row['high']:+.3f})"
    verdict = "yes" if row["low"] > 0 else "no, the reverse" if row["high"] < 0 else "not told apart"
    cells = [row["environment"], f"`{row['better']}` over `{row['worse']}`", numbers, row["seeds"], verdict]
    return f"| {' | '.join(cells)} |"


def write(path: pathlib.Path, rows: list[dict[str, Any]]) -> None:
    """Write rows as CSV, numbers to four digits."""
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows({k: round(v, 4) if isinstance(v, float) else v for k, v in row.items()} for row in rows)


def table(columns: list[str], lines: list[str]) -> str:
    """Return a table in Markdown."""
    return "\n".join([f"| {' | '.join(columns)} |", "|---" * len(columns) + "|", *lines])


def line(row: dict[str, Any]) -> str:
    """Return a row in Markdown."""
    cells = [
        row["environment"],
        f"{row['steps']:,}".replace(",", " "),
        f"`{row['method']}`",
        f"{row['mean']:.3f}",
        f"{row['iqm']:.3f} ({row['low']:.3f} to {row['high']:.3f})",
        f"{row['worst']:.2f} to {row['best']:.2f}",
        str(row["seeds"]),
        "-" if math.isnan(row["steps_to_goals_reached"]) else f"{row['steps_to_goals_reached']:.0f}",
    ]
    return f"| {' | '.join(cells)} |"


def main() -> None:
    """Write ``PLAN_summary.csv`` and ``PLAN_order.csv`` into the folder and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("plan", type=pathlib.Path)
    parser.add_argument("out", type=pathlib.Path, help="folder of all runs")
    args = parser.parse_args()
    done = [run for run in status(load_plan(args.plan), args.out) if run.state == "done"]
    if not done:
        raise SystemExit(f"no run of {args.plan} is finished in {args.out}")
    groups = by_method(done)
    rows, compared = summarise(groups, args.out), compare(groups)
    write(args.out / f"{args.plan.stem}_summary.csv", rows)
    columns = ["Task", "Steps", "Method", "Mean", "IQM (95 %)", "Seeds' range", "Seeds", "Steps to goals reached"]
    print(table(columns, [*map(line, rows)]))
    orders = args.out / f"{args.plan.stem}_order.csv"
    orders.unlink(missing_ok=True)
    if compared:
        write(orders, compared)
        print()
        print(
            table(["Task", "Is better", "Difference of means (95 %)", "Seeds", "Told apart"], [*map(compared_line, compared)])
        )


if __name__ == "__main__":
    main()
