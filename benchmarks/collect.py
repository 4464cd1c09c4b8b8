"""Sum up the finished runs of a plan as tidy tables under ``benchmarks/results/``.

    sb3-skillgraph compare benchmarks/point_mazes.yml --out runs/point_mazes --jobs 2
    python -m benchmarks.collect benchmarks/point_mazes.yml runs/point_mazes

writes into ``benchmarks/results/point_mazes/``: ``runs.csv`` (a row for each method and seed), ``curves.csv`` (for each of
their tests), ``promises.csv`` (what plans promised beside what happened, in bins of a fifth), ``summary.csv`` (means over
seeds with intervals, and each method's difference to the first) and ``command.txt``. What the tables hold of other seeds or
methods of the plan stays: run folders may be gone when the next ones are collected.
"""

import argparse
import csv
import functools
import math
import pathlib
from collections.abc import Iterable, Iterator
from typing import Any

import gymnasium as gym
import numpy as np
from scipy import stats

from benchmarks.shortest import Shortest
from sb3_skillgraph.calibration import brier_score, calibration
from sb3_skillgraph.experiments.plan import RunSpec, load_plan
from sb3_skillgraph.experiments.run_folder import CONFIG, DONE, SECONDS, STEPS, read_json, read_progress
from sb3_skillgraph.experiments.status import status

RESULTS = pathlib.Path(__file__).parent / "results"
Row = dict[str, Any]
KEY = ("environment", "method", "seed")
KEYS = {"runs": KEY, "curves": (*KEY, "steps"), "promises": (*KEY, "steps", "low")}
#: Columns that are words even where they look like numbers, as a commit such as 72e3967 does (it would be infinite).
WORDS = ("environment", "method", "version", "commit")
#: Seeds from which on a bootstrap says something; with fewer a t interval is wider, and safer.
ENOUGH_SEEDS = 5
N_SAMPLES = 10_000  # of the bootstrap


def described(test: dict[str, Any], ours: dict[str, Any] | None, shortest: Shortest | None) -> Row:
    """Return what is kept of a test: rates, steps, falls.

    :param test: as a run wrote it
    :param ours: that of the plan's first method after the same steps with the same pairs; None where there is none
    :param shortest: tells the fewest steps to a goal; None where nobody knows
    """
    pairs = test["pairs"]
    reached = [pair for pair in pairs if pair["success"]]
    beside = zip(pairs, [] if ours is None else ours["pairs"], strict=False)
    both = [(a["steps"], b["steps"]) for a, b in beside if a["success"] and b["success"]]
    of_first = sum(steps for _, steps in both)
    row: Row = {
        "pairs": len(pairs),
        "success_rate": test["success_rate"],
        "task_success_rate": _mean([pair["success"] for task in test.get("tasks", []) for pair in task]),
        "steps_to_goals": _mean([pair["steps"] for pair in reached]),
        "steps_over_first": sum(steps for steps, _ in both) / of_first if of_first else math.nan,
        "times_shortest": math.nan,
        "falls": sum(pair["stuck"] for pair in pairs),
    }
    if shortest is not None and reached:
        fewest = sum(shortest(np.array(pair["start"]), np.array(pair["goal"])) for pair in reached)
        row["times_shortest"] = sum(pair["steps"] for pair in reached) / fewest
    return row


def _mean(values: list[Any]) -> float:
    return float(np.mean(values)) if values else math.nan


@functools.cache
def shortest_of(env_id: str) -> Shortest | None:
    """Return what tells the fewest steps in a maze; None where that is not known."""
    if not env_id.startswith("SkillGraph/OGBenchPoint"):
        return None
    env = gym.make(env_id)
    return Shortest(env.get_wrapper_attr("geometry"), env.get_wrapper_attr("success_radius"))


def tests_of(spec: RunSpec, out: pathlib.Path) -> Iterator[tuple[int, float, dict[str, Any]]]:
    """Return a run's tests: steps, seconds of training, and what came of it."""
    folder = spec.folder(out)
    for row in read_progress(folder):
        yield row[STEPS], float(row[SECONDS]), read_json(folder / f"test_{row[STEPS]}.json")


def rows_of(spec: RunSpec, first: RunSpec, out: pathlib.Path) -> dict[str, list[Row]]:
    """Return the rows of a finished run, by table.

    :param spec: the run
    :param first: that of the plan's first method with the same seed
    :param out: folder of all runs
    """
    versions = read_json(spec.folder(out) / CONFIG)["versions"]
    version = {"version": versions["sb3_skillgraph"], "commit": versions["commit"]}
    shortest = shortest_of(spec.env_id)
    reference = {steps: test for steps, _, test in tests_of(first, out)} if (first.folder(out) / DONE).exists() else {}
    tables: dict[str, list[Row]] = {name: [] for name in KEYS}
    key = {"environment": spec.environment, "method": spec.method, "seed": spec.seed}
    for steps, seconds, test in tests_of(spec, out):
        row = {**key, "steps": steps, "seconds": seconds, **described(test, reference.get(steps), shortest)}
        tables["curves"].append(row)
        episodes = [*test["pairs"], *(pair for task in test.get("tasks", []) for pair in task)]
        promises = [(episode["promised"], episode["success"]) for episode in episodes if "promised" in episode]
        brier = {"brier": brier_score(promises)} if promises else {}
        tables["promises"] += [{**key, "steps": steps, **bin._asdict(), **brier} for bin in calibration(promises)]
    if tables["curves"]:
        tables["runs"] = [{**tables["curves"][-1], **version}]
    for name, test in read_json(spec.folder(out) / DONE)["also"].items():
        last = tables["curves"][-1]
        also = described(test, reference.get(spec.steps), shortest)
        tables["runs"].append({**key, "method": name, "steps": spec.steps, "seconds": last["seconds"], **also, **version})
    return tables


def read(path: pathlib.Path) -> list[Row]:
    """Read a table; an empty one where there is none."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    return [{name: value if name in WORDS else _number(value) for name, value in row.items()} for row in rows]


def _number(text: str) -> int | float:
    try:
        return int(text)
    except ValueError:
        return float(text)


def write(path: pathlib.Path, rows: list[Row]) -> None:
    """Write a table, numbers to four digits."""
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows({k: round(v, 4) if isinstance(v, float) else v for k, v in row.items()} for row in rows)


def merged(old: Iterable[Row], new: Iterable[Row], key: tuple[str, ...]) -> list[Row]:
    """Put new rows in the place of old ones of the same run, and all in order."""
    new = list(new)
    done = {tuple(row[name] for name in KEY) for row in new}
    rows = [row for row in old if tuple(row[name] for name in KEY) not in done] + new
    return sorted(rows, key=lambda row: tuple(row[name] for name in key))


def summarise(runs: list[Row], order: list[str], first: str) -> list[Row]:
    """Return a row for each method on each environment: the mean over seeds with its 95 % interval, the best first.

    :param runs: a row for each run
    :param order: the environments
    :param first: the method that the others are compared with, seed by seed
    """
    rows = []
    for environment in order:
        here = [run for run in runs if run["environment"] == environment]
        rates = {name: {run["seed"]: run["success_rate"] for run in here if run["method"] == name} for name in names(here)}
        for method, by_seed in rates.items():
            mean, low, high = interval(list(by_seed.values()), (0.0, 1.0))
            own = [run for run in here if run["method"] == method]
            row: Row = {"environment": environment, "method": method, "steps": own[0]["steps"], "seeds": len(by_seed)}
            row |= {"mean": mean, "low": low, "high": high, "worst": min(by_seed.values()), "best": max(by_seed.values())}
            for name in ("task_success_rate", "steps_to_goals", "steps_over_first", "times_shortest", "falls", "seconds"):
                values = [run[name] for run in own if not math.isnan(run[name])]
                row[name] = _mean(values)
            shared = [rate - rates[first][seed] for seed, rate in by_seed.items() if seed in rates.get(first, {})]
            difference = interval(shared, (-1.0, 1.0)) if shared and method != first else (math.nan,) * 3
            row |= dict(zip(("difference", "difference_low", "difference_high"), difference, strict=True))
            rows.append(row)
    return sorted(rows, key=lambda row: (order.index(row["environment"]), -row["mean"], row["method"] != first))


def names(runs: list[Row]) -> list[str]:
    """Return the methods of some runs, each once."""
    return list(dict.fromkeys(run["method"] for run in runs))


def interval(values: list[float], bounds: tuple[float, float]) -> tuple[float, float, float]:
    """Return mean and 95 % interval: a bootstrap over seeds where there are five, else a t interval.

    :param values: one for each seed; differences of two methods are paired so
    :param bounds: least and greatest value there can be
    """
    mean = float(np.mean(values))
    if len(values) < 2:
        return mean, math.nan, math.nan
    if len(values) >= ENOUGH_SEEDS:
        drawn = np.random.default_rng(0).choice(values, (N_SAMPLES, len(values)))
        low, high = np.quantile(drawn.mean(axis=1), [0.025, 0.975])
        return mean, float(low), float(high)
    half = float(stats.t.ppf(0.975, len(values) - 1) * stats.sem(values))
    return mean, max(bounds[0], mean - half), min(bounds[1], mean + half)


def collect(plan: pathlib.Path, out: pathlib.Path, results: pathlib.Path) -> list[Row]:
    """Add the finished runs of a plan to its tables.

    :param plan: the plan
    :param out: folder of its runs
    :param results: folder of the tables
    :return: the rows of the summary
    """
    specs = load_plan(plan)
    firsts = {(spec.environment, spec.seed): spec for spec in reversed(specs)}
    new: dict[str, list[Row]] = {name: [] for name in KEYS}
    for run in status(specs, out):
        if run.state == "done":
            for name, rows in rows_of(run.spec, firsts[run.spec.environment, run.spec.seed], out).items():
                new[name] += rows
    results.mkdir(parents=True, exist_ok=True)
    for name, key in KEYS.items():
        rows = merged(read(results / f"{name}.csv"), new[name], key)
        if rows:
            write(results / f"{name}.csv", rows)
    summary = summarise(read(results / "runs.csv"), list(dict.fromkeys(spec.environment for spec in specs)), specs[0].method)
    write(results / "summary.csv", summary)
    name = plan.stem
    (results / "command.txt").write_text(
        f"sb3-skillgraph compare benchmarks/{name}.yml --out runs/{name} --jobs 2\n"
        f"python -m benchmarks.collect benchmarks/{name}.yml runs/{name}\n"
    )
    return summary


def main() -> None:
    """Collect runs and print the summary."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("plan", type=pathlib.Path)
    parser.add_argument("runs", type=pathlib.Path, help="folder of all runs")
    args = parser.parse_args()
    for row in collect(args.plan, args.runs, RESULTS / args.plan.stem):
        rates = f"{row['mean']:.3f} ({row['low']:.3f} to {row['high']:.3f})"
        print(f"{row['environment']:>15} {row['method']:>22} {row['steps']:>8} steps {row['seeds']} seeds {rates}")


if __name__ == "__main__":
    main()
