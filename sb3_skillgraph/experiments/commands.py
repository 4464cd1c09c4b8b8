"""The commands ``compare``, ``status`` and ``figure``."""

import argparse
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from sb3_skillgraph.experiments.console import UserError, for_people, positive
from sb3_skillgraph.experiments.figures import redraw
from sb3_skillgraph.experiments.opening import add_command
from sb3_skillgraph.experiments.plan import RunSpec, load_plan
from sb3_skillgraph.experiments.run_folder import ERROR
from sb3_skillgraph.experiments.runner import compare
from sb3_skillgraph.experiments.status import RunStatus, by_method, status
from sb3_skillgraph.experiments.summary import estimate
from sb3_skillgraph.plotting import save_figure


def add_compare(commands: Any) -> None:
    """Add ``compare``.

    :param commands: argparse's sub-parsers
    """
    command = _add(
        commands,
        "compare",
        _compare,
        "Run methods on environments with several seeds; what is done is skipped, what was killed goes on.",
        "PLAN names methods, environments and seeds (benchmarks/point_mazes.yml is one). Several may work in one OUT.\n\n"
        "example:\n  sb3-skillgraph compare benchmarks/point_mazes.yml --out runs/point_mazes --jobs 2",
    )
    command.add_argument("--jobs", type=positive, default=1, help="runs at a time (default: 1)")
    command.add_argument(
        "--backend", choices=("loky", "ray", "dask"), default="loky", help="what joblib runs them on (default: loky)"
    )


def add_status(commands: Any) -> None:
    """Add ``status``.

    :param commands: argparse's sub-parsers
    """
    _add(
        commands,
        "status",
        _status,
        "Show how the runs of a plan stand, and how long they will take.",
        "example:\n  sb3-skillgraph status benchmarks/point_mazes.yml --out runs/point_mazes",
    )


def add_figure(commands: Any) -> None:
    """Add ``figure``.

    :param commands: argparse's sub-parsers
    """
    command = commands.add_parser(
        "figure",
        help="Redraw a figure of the paper from the runs of a plan.",
        description="3 frontier and Fiedler values; 4 exploration; 5 learning curves; 6 growth of the graph; "
        "9 where deep covering options fail.\n\n"
        "example:\n  sb3-skillgraph figure 5 benchmarks/point_mazes.yml --out runs/point_mazes --to figure_5.png",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    command.set_defaults(run=_figure)
    command.add_argument("number", type=int, metavar="N", help="3, 4, 5, 6 or 9")
    _add_plan(command)
    command.add_argument("--environment", help="draw this one of the plan's environments (default: the first; 5 draws all)")
    command.add_argument("--method", help="draw this one of the plan's methods (default: the first that fits)")
    command.add_argument("--to", type=Path, required=True, metavar="FILE.png", help="the picture; .svg and .pdf work, too")


def _add(commands: Any, name: str, run: Any, summary: str, detail: str) -> argparse.ArgumentParser:
    command = add_command(commands, name, run, summary, detail)
    _add_plan(command)
    return command


def _add_plan(command: argparse.ArgumentParser) -> None:
    command.add_argument("plan", type=Path, metavar="PLAN.yml", help="methods, environments and seeds")
    command.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of all runs")


def _read(args: argparse.Namespace) -> list[RunSpec]:
    if not args.plan.is_file():
        raise UserError(f"there is no plan {args.plan}.")
    with for_people():
        return load_plan(args.plan)


def _compare(args: argparse.Namespace) -> int:
    specs = _read(args)
    with for_people():
        outcomes = compare(specs, args.out, args.jobs, args.backend)
    _print_status(status(specs, args.out))
    counts = Counter(outcomes)
    print(", ".join(f"{n} {outcome}" for outcome, n in counts.items()))
    for spec, outcome in zip(specs, outcomes, strict=True):
        if outcome == "failed":
            print(f"failed: see {spec.folder(args.out) / ERROR}")
        if outcome == "refused":
            print(f"refused: {spec.folder(args.out)} holds a run with other settings: remove it, or choose another folder")
    return 1 if counts["failed"] or counts["refused"] else 0


def _status(args: argparse.Namespace) -> int:
    _print_status(status(_read(args), args.out))
    return 0


def _print_status(runs: list[RunStatus]) -> None:
    table = Table()
    for column in ("environment", "method"):
        table.add_column(column, no_wrap=True)
    for column in ("done", "running", "failed", "steps", "success (IQM, 95 %)", "time left, one by one"):
        table.add_column(column, justify="right")
    for (environment, method), here in by_method(runs).items():
        states = Counter(run.state for run in here)
        scores = [run.success_rate for run in here if run.state == "done" and run.success_rate is not None]
        success = "-"
        if scores:
            mean, low, high = estimate(np.array([scores]))
            success = f"{mean:.2f} ({low:.2f} to {high:.2f})"
        known = [run.seconds_left for run in here if run.seconds_left is not None and run.state != "done"]
        waiting = sum(run.seconds_left is None and run.state != "other" for run in here)
        left = [f"{sum(known) / 60:.0f} min"] * bool(known) + [f"{waiting} to begin"] * bool(waiting)
        counts = (f"{states['done']}/{len(here)}", str(states["running"]), str(states["failed"]))
        steps = f"{sum(run.steps for run in here):,} of {sum(run.spec.steps for run in here):,}"
        table.add_row(environment, method, *counts, steps, success, " and ".join(left) or "-")
    # Where nobody watches there is no width to keep to, and rich would take 80 columns.
    Console(width=None if sys.stdout.isatty() else 200).print(table)
    others = sum(run.state == "other" for run in runs)
    if others:
        print(f"{others} in the place of which there is a run with other settings; they are left out")


def _figure(args: argparse.Namespace) -> int:
    specs = _read(args)
    for name, wanted in (("environment", args.environment), ("method", args.method)):
        known = list(dict.fromkeys(getattr(spec, name) for spec in specs))
        if wanted is not None and wanted not in known:
            raise UserError(f"the plan has no {name} {wanted!r}; it has {', '.join(known)}.")
        if wanted is not None:
            specs = [spec for spec in specs if getattr(spec, name) == wanted]
    if args.number != 5:
        specs = [spec for spec in specs if spec.environment == specs[0].environment]
    with for_people():
        save_figure(redraw(args.number, specs, args.out), args.to)
    print(f"the picture is {args.to}")
    return 0
