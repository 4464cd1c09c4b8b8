"""Write ``docs/results.md`` and the README's table from the tables under ``benchmarks/results/``: no number is typed.

python -m benchmarks.report
"""

import json
import math
import pathlib
import re
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from benchmarks.collect import RESULTS, Row, read

ROOT = pathlib.Path(__file__).parents[1]
PAGE, README = ROOT / "docs" / "results.md", ROOT / "README.md"
BEGIN, END = "<!-- results: python -m benchmarks.report -->", "<!-- end of results -->"
#: Plans in a bin of promises from which on it is shown.
ENOUGH_PLANS = 100

TASKS = {
    "umaze": "Point maze, UMaze",
    "medium": "Point maze, Medium",
    "hard": "Point maze, Hard",
    "car-medium": "Car, Medium",
    "key-door": "Key and door",
    "fetch-reach": "`FetchReach-v4`",
    "panda-reach": "`PandaReach-v3`",
    "point-large": "`PointMaze_Large-v3`",
    "fetch-push": "`FetchPush-v4`",
    "parking": "`parking-v0` of highway-env",
    "ant-umaze-v5": "`AntMaze_UMaze-v5`, recipe's wrappers",
    "ant-umaze": "Ant, U-maze",
    "ant-reacher": "Ant, open floor",
    "ant-medium": "Ant, Medium",
    "ant-large": "Ant, Large",
    "ant-teleport": "Ant, teleporters",
}
OGBENCH = {
    "medium": "`pointmaze-medium-v0`",
    "large": "`pointmaze-large-v0`",
    "giant": "`pointmaze-giant-v0`",
    "teleport": "`pointmaze-teleport-v0`",
    "giant-100": "giant, episodes of 100 steps from anywhere",
    "giant-200": "giant, episodes of 200 steps from anywhere",
    "ant-medium": "`antmaze-medium-v0`",
    "ant-large": "`antmaze-large-v0`",
    "ant-teleport": "`antmaze-teleport-v0`",
}
#: Success of the best published method on OGBench's tasks, learned offline from its data.
PUBLISHED = {
    "medium": 0.91,
    "large": 0.88,
    "giant": 0.92,
    "teleport": 0.57,
    "ant-medium": 0.96,
    "ant-large": 0.93,
    "ant-teleport": 0.53,
}


def number(value: float, digits: int = 2) -> str:
    """Return a number as text, a dash where there is none."""
    return "-" if math.isnan(value) else f"{value:.{digits}f}"


def few(row: Row) -> str:
    """Return what is added to a number that only one seed or two have given."""
    return {1: " (one seed)", 2: " (two seeds)"}.get(row["seeds"], "")


def rate(row: Row) -> str:
    """Return a mean over seeds with its interval."""
    if math.isnan(row["low"]):
        return f"{row['mean']:.2f}{few(row)}"
    return f"{row['mean']:.3f} ({row['low']:.2f} to {row['high']:.2f})"


def verdict(row: Row) -> str:
    """Tell whether a method differs from the first of its plan."""
    if math.isnan(row["difference"]):
        return ""
    if math.isnan(row["difference_low"]):
        return f"{row['difference']:+.2f}"
    told = "told apart" if row["difference_low"] > 0 or row["difference_high"] < 0 else "not told apart"
    return f"{row['difference']:+.2f} ({row['difference_low']:+.2f} to {row['difference_high']:+.2f}), {told}"


def table(head: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    return "\n".join(f"| {' | '.join(line)} |" for line in (head, ["---"] * len(head), *lines))


def summary(plan: str) -> list[Row]:
    """Read a plan's summary."""
    return read(RESULTS / plan / "summary.csv")


def command(plan: str) -> str:
    """Return the commands that made a folder of results."""
    return "\n".join(["```", (RESULTS / plan / "command.txt").read_text().strip(), "```"])


def methods(plan: str) -> str:
    """Return a table of all methods of a plan on all its tasks."""
    rows = summary(plan)
    # The one that the others are compared with, which need not be the best
    first = next(f"`{row['method']}`" for row in rows if math.isnan(row["difference"]))
    head = ("Task", "Steps", "Method", "Success", f"Difference to {first}", "Steps to goals", f"Over {first}", "Seeds")
    lines = [
        (
            {**OGBENCH, **TASKS}[row["environment"]],
            str(row["steps"]),
            f"`{row['method']}`",
            rate(row),
            verdict(row),
            number(row["steps_to_goals"], 0),
            number(row["steps_over_first"]),
            str(row["seeds"]),
        )
        for row in rows
    ]
    return table(head, lines)


def rates_by_steps(rows: Sequence[Row]) -> dict[int, list[float]]:
    """Return the success of all seeds after each number of steps, ascending.

    :param rows: of a method's tests
    """
    ascending = sorted({row["steps"] for row in rows})
    return {steps: [row["success_rate"] for row in rows if row["steps"] == steps] for steps in ascending}


def curves_of(plan: str, method: str) -> str:
    """Return how a method's success grows with the steps, one line for each of a plan's tasks."""
    environments = [row["environment"] for row in summary(plan) if row["method"] == method]
    rows = [row for row in read(RESULTS / plan / "curves.csv") if row["method"] == method]
    lines = []
    for environment in environments:
        here = [row for row in rows if row["environment"] == environment]
        text = ", ".join(f"{np.mean(rates):.2f} ({steps})" for steps, rates in rates_by_steps(here).items())
        lines.append(f"* {TASKS[environment]}: {text}.")
    return "\n".join(lines)


def ogbench(plan: str) -> str:
    """Return a table of OGBench's mazes."""
    rows = summary(plan)
    head = ("Maze", "Steps", "Method", "Official tasks", "Best published", "Random pairs", "Times the shortest", "Seeds")
    lines = [
        (
            OGBENCH[row["environment"]],
            str(row["steps"]),
            f"`{row['method']}`",
            number(row["task_success_rate"], 3),
            number(PUBLISHED.get(row["environment"], math.nan)),
            rate(row),
            number(row["times_shortest"]),
            str(row["seeds"]),
        )
        for row in rows
    ]
    return table(head, lines)


def ants() -> str:
    """Return the table of the ants, seed by seed."""
    rows = read(RESULTS / "ants" / "curves.csv")
    lines = []
    for environment, method, steps in sorted({(row["environment"], row["method"], row["steps"]) for row in rows}):
        here = [row for row in rows if (row["environment"], row["method"], row["steps"]) == (environment, method, steps)]
        seeds = ", ".join(f"{row['success_rate']:.2f}" for row in here)
        falls = ", ".join(str(row["falls"]) for row in here)
        mean = f"{np.mean([row['success_rate'] for row in here]):.3f} ({seeds})"
        to_goals = number(float(np.mean([row["steps_to_goals"] for row in here])), 0)
        lines.append((TASKS[environment], f"`{method}`", str(steps), mean, to_goals, falls))
    return table(("Task", "Method", "Steps", "Success", "Steps to goals", "Falls"), lines)


def straight_on(plan: str) -> str:
    """Return, task by task, what the same walker does without its graph."""
    rows = [row for row in summary(plan) if row["method"] == "straight-on"]
    return ", ".join(f"{row['mean']:.2f} ({TASKS[row['environment']]})" for row in rows)


def promises(plan: str, environment: str) -> str:
    """Return what plans promised beside what happened, all seeds and tests together."""
    mine = [row for row in read(RESULTS / plan / "promises.csv") if row["environment"] == environment]
    mine = [row for row in mine if row["method"] == "skill-graph"]
    bins = []
    for low in sorted({row["low"] for row in mine}):
        here = [row for row in mine if row["low"] == low]
        n_plans = [row["n_plans"] for row in here]
        if sum(n_plans) >= ENOUGH_PLANS:
            promised, observed = (
                np.average([row[name] for row in here], weights=n_plans) for name in ("promised", "observed")
            )
            bins.append(f"{promised:.2f} promised, {observed:.2f} happened ({sum(n_plans)} plans)")
    tests = {(row["seed"], row["steps"]): row["brier"] for row in mine}
    sizes = {key: sum(row["n_plans"] for row in mine if (row["seed"], row["steps"]) == key) for key in tests}
    brier = np.average(list(tests.values()), weights=list(sizes.values()))
    happened = np.average([row["observed"] for row in mine], weights=[row["n_plans"] for row in mine])
    return f"{'; '.join(bins)}; Brier score {brier:.3f}, of always saying the mean {happened * (1 - happened):.3f}"


def kept(environment: str, begin: int) -> str:
    """Tell the least success of all tests from some number of steps on."""
    rows = [
        row for row in read(RESULTS / "kept" / "curves.csv") if row["environment"] == environment and row["steps"] >= begin
    ]
    means = [np.mean([r["success_rate"] for r in rows if r["steps"] == steps]) for steps in {row["steps"] for row in rows}]
    end, n_seeds = max(row["steps"] for row in rows), len({row["seed"] for row in rows})
    worst = min(row["success_rate"] for row in rows)
    lowest = f"the mean over {n_seeds} seeds is never below {min(means):.3f}, and no seed below {worst:.2f}"
    return f"from {begin} to {end} steps {lowest}"


def few_shot() -> str:
    """Return success after so many further steps."""
    rows = read(RESULTS / "few_shot" / "runs.csv")
    extra = sorted({row["extra_steps"] for row in rows})
    means = [f"{np.mean([r['success_rate'] for r in rows if r['extra_steps'] == n]):.2f} ({n})" for n in extra]
    lost = np.mean([row["old_pairs_before"] - row["old_pairs_after"] for row in rows])
    return f"{', '.join(means)}; of the pairs that were reached before {lost:.3f} are lost"


def document(name: str) -> Any:
    """Read a result that is no table."""
    return json.loads((RESULTS / name).read_text())


def older() -> str:
    """Return what steps to goals are of those of version 0.1.0."""
    parts = [
        f"{each['environment']} after {each['training_steps']} steps {each['ratio']:.2f} times ({each['pairs']} pairs)"
        for each in document("steps_against_0.1.0.json")["comparisons"]
    ]
    return "; ".join(parts)


def wall_clock(file: str) -> str:
    """Return the seconds to success, and the success of DDPG with hindsight after as many where it was run."""
    tasks = {name: runs for name, runs in document(file).items() if isinstance(runs, list)}
    parts = []
    for name, runs in tasks.items():
        seconds = ", ".join(f"{run['seconds']:.0f}" for run in runs)
        hindsight = f" ({', '.join(number(run['her']) for run in runs)})" if all("her" in run for run in runs) else ""
        parts.append(f"{name} {seconds} s{hindsight}")
    return "; ".join(parts)


def scaling() -> str:
    """Return what grows."""
    result = document("scaling.json")

    def each(rows: list[Row], name: str, factor: float = 1.0, digits: int = 2) -> str:
        return ", ".join(f"{factor * row[name]:.{digits}f}" for row in rows)

    visited, events = result["visited"], result["events"]
    return (
        f"with {each(visited, 'visited', 1, 0)} stored transitions a learning step on the toy takes "
        f"{each(visited, 'learning_step_ms')} ms, a `predict` while an option runs "
        f"{each(visited, 'predict_ms', 1000, 0)} µs, a decision {each(visited, 'decision_ms')} ms; "
        f"with {each(events, 'events', 1, 0)} events of 32 edges each a decision takes "
        f"{each(events, 'decision_ms', 1, 1)} ms, the mask of `OptionsEnv` with an action for each "
        f"{each(events, 'mask_ms', 1, 1)} ms"
    )


def throughput() -> str:
    """Return the milliseconds of a step of learning with an update each."""
    cases = [
        case for case in document("throughput.json")["cases"] if case["net_arch"] == [128, 128] and case["train_freq"] == 1
    ]
    return "; ".join(
        f"{case['env']} {case['ours']['total']:.1f} ms, SB3's DDPG {case['sb3']['total']:.1f} ms" for case in cases
    )


def updates() -> str:
    """Return what one update costs, beside SB3's and, where it was measured, SBX's."""
    parts = []
    for case in document("update.json")["cases"]:
        fresh = case["fresh"]
        peer = f", SBX's {fresh['sbx']:.2f} ms" if "sbx" in fresh else ""
        layers = "-".join(map(str, case["net_arch"]))
        parts.append(
            f"{case['algorithm']} {layers}, minibatches of {case['batch_size']}: {fresh['kernel']:.2f} ms, SB3's "
            f"{fresh['sb3']:.2f} ms ({fresh['speedup']:.2f} times ours; aged {case['aged']['speedup']:.2f}){peer}"
        )
    return "; ".join(parts)


def soak() -> str:
    """Return how a million steps went."""
    result = document("soak.json")
    return (
        f"the last tenth goes at {result['last_over_second']:.2f} of the pace of the second, and the process holds "
        f"{result['memory_since_full']:.3f} times the memory that it held when its replay buffer became full"
    )


def beside(rows: dict[tuple[str, str], Row], environment: str, name: str) -> list[str]:
    """Return what other methods came to, where they were run; one seed or two are told.

    :param rows: by environment and method
    :param environment: which of them
    :param name: column
    """
    others = [rows.get((environment, method)) for method in ("straight-on", "ddpg-her")]
    return ["" if row is None else f"{row[name]:.2f}{few(row)}" for row in others]


def readme_table() -> str:
    """Return the README's table."""
    lines = []
    for plan, shown in (
        ("point_mazes", ("medium", "hard")),
        ("kept", ("key-door",)),
        ("foreign", ("fetch-reach", "panda-reach", "point-large", "ant-umaze-v5", "fetch-push", "parking")),
        ("ants", ("ant-umaze", "ant-medium", "ant-large")),
    ):
        rows = {(row["environment"], row["method"]): row for row in summary(plan)}
        for environment in shown:
            ours = rows[environment, "skill-graph"]
            lines.append((TASKS[environment], str(ours["steps"]), rate(ours), *beside(rows, environment, "mean")))
    official = {(row["environment"], row["method"]): row for row in [*summary("ogbench"), *summary("ogbench_ants")]}
    for environment in ("giant", "teleport", "ant-medium", "ant-large", "ant-teleport"):
        ours = official[environment, "skill-graph"]
        success = f"{ours['task_success_rate']:.3f}{few(ours)}"
        if environment in PUBLISHED:
            success += f"; best published, offline: {PUBLISHED[environment]}"
        lines.append(
            (
                f"{OGBENCH[environment]}, official tasks",
                str(ours["steps"]),
                success,
                *beside(official, environment, "task_success_rate"),
            )
        )
    return table(("Task", "Steps of training", "Success", "Straight on", "DDPG + HER"), lines)


def page() -> str:
    """Return the page."""
    template = (ROOT / "benchmarks" / "results.template.md").read_text()
    known: dict[str, Callable[..., str]] = {
        function.__name__: function
        for function in (ants, command, curves_of, few_shot, kept, methods, ogbench, older, promises, scaling, soak)
    }
    known |= {function.__name__: function for function in (straight_on, throughput, updates, wall_clock)}

    def fill(match: re.Match[str]) -> str:
        name, *arguments = match[1].split()
        return known[name](*(int(word) if word.isdigit() else word for word in arguments))

    return re.sub(r"\{\{ ([^}]+) \}\}", fill, template)


def main() -> None:
    """Write both."""
    PAGE.write_text(page())
    text = README.read_text()
    begin, end = text.index(BEGIN) + len(BEGIN), text.index(END)
    README.write_text(f"{text[:begin]}\n{readme_table()}\n{text[end:]}")


if __name__ == "__main__":
    main()
