"""Sum up the finished runs of a plan: a CSV, and the README's table.

python -m benchmarks.compare_table benchmarks/compare.yml benchmarks/results/compare
"""

import argparse
import csv
import pathlib
from typing import Any

import numpy as np

from sb3_skillgraph.experiments.plan import RunSpec, load_plan
from sb3_skillgraph.experiments.runner import status
from sb3_skillgraph.experiments.summary import estimate


def summarise(specs: list[RunSpec], out: pathlib.Path) -> list[dict[str, Any]]:
    """Return a row for every method on every environment that has a finished run, the best first."""
    rows = []
    done = [run for run in status(specs, out) if run.state == "done"]
    for environment, method in dict.fromkeys((run.spec.environment, run.spec.method) for run in done):
        here = [run for run in done if (run.spec.environment, run.spec.method) == (environment, method)]
        scores = np.array([run.success_rate for run in here])
        iqm, low, high = estimate(scores[None])
        rows.append(
            {
                "environment": environment,
                "method": method,
                "steps": here[0].spec.steps,
                "seeds": len(scores),
                "mean": scores.mean(),
                "iqm": iqm,
                "low": low,
                "high": high,
                "worst": scores.min(),
                "best": scores.max(),
            }
        )
    order = list(dict.fromkeys(row["environment"] for row in rows))
    return sorted(rows, key=lambda row: (order.index(row["environment"]), -row["mean"]))


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
    ]
    return f"| {' | '.join(cells)} |"


def main() -> None:
    """Write ``summary.csv`` into the folder and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("plan", type=pathlib.Path)
    parser.add_argument("out", type=pathlib.Path, help="folder of all runs")
    args = parser.parse_args()
    rows = summarise(load_plan(args.plan), args.out)
    if not rows:
        raise SystemExit(f"no run of {args.plan} is finished in {args.out}")
    with (args.out / "summary.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows({k: round(v, 4) if isinstance(v, float) else v for k, v in row.items()} for row in rows)
    columns = ("Task", "Steps", "Method", "Mean", "IQM (95 %)", "Seeds' range", "Seeds")
    print("\n".join([f"| {' | '.join(columns)} |", "|---" * len(columns) + "|", *map(line, rows)]))


if __name__ == "__main__":
    main()
