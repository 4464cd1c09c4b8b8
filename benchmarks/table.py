"""Print the README's table of zero-shot results from the files that hold them.

python -m benchmarks.table benchmarks/results/zero_shot_*.json
"""

import argparse
import json
import pathlib
from typing import Any

COLUMNS = (
    "Maze",
    "Steps of training",
    "Success",
    "At the paper's tolerance",
    "Planning off",
    "On minus off",
    "Steps under planned options",
    "Planned options that succeed",
    "File",
)


def cell(rate: dict[str, Any]) -> str:
    """Return a mean with its standard error."""
    return f"{rate['mean']:.3f} ± {rate['standard_error']:.3f}"


def row(path: pathlib.Path) -> str:
    """Return the line of one file."""
    document = json.loads(path.read_text())
    steps = document["runs"][0]["checks"][-1][0]
    low, high = document["planning_on_minus_off"]["interval"]
    cells = [
        path.stem.removeprefix("zero_shot_").replace("_", " "),
        f"{steps:,}".replace(",", " "),
        f"{cell(document['success_rate'])} ({len(document['runs'])} seeds)",
        cell(document["success_rate_close"]),
        cell(document["success_rate_planning_off"]),
        f"{document['planning_on_minus_off']['mean']:+.2f} ({low:+.2f} to {high:+.2f})",
        f"{document['planned_share']['mean']:.2f}",
        f"{document['option_success_rate']['mean']:.2f}",
        f"`{path}`",
    ]
    return f"| {' | '.join(cells)} |"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", type=pathlib.Path, nargs="+")
    args = parser.parse_args()
    print("\n".join([f"| {' | '.join(COLUMNS)} |", "|---" * len(COLUMNS) + "|", *map(row, args.files)]))


if __name__ == "__main__":
    main()
