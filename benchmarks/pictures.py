"""Draw ``docs/learning_curves.png`` from the tables under ``benchmarks/results/`` (the paper's Figure 5).

python -m benchmarks.pictures
"""

import numpy as np

from benchmarks.collect import RESULTS, Row, read
from benchmarks.report import PAGE, rates_by_steps
from sb3_skillgraph.plotting.figures import save_figure
from sb3_skillgraph.plotting.paper_figures import Curve, add_legend, new_panels, plot_curves

#: Methods in the order of the legend.
METHODS = ("skill-graph", "paper-rrt", "paper-dco", "dco-5", "uvfa")
#: The panels: titles, and the plans whose runs on Medium they show.
PANELS = {
    "Medium, three to eight seeds": ("point_mazes", "kept", "paper"),
    "Medium, one seed for longer": ("paper_long",),
}


def curve(rows: list[Row]) -> Curve:
    """Return one method's success against steps: the mean over seeds, the least and the most.

    :param rows: of its tests
    """
    by_steps = rates_by_steps(rows)
    mean, least, most = (np.array([of(rates) for rates in by_steps.values()]) for of in (np.mean, min, max))
    return Curve(np.array(list(by_steps)), mean, least, most)


def main() -> None:
    """Draw the picture."""
    panels = new_panels(len(PANELS))
    shown = set()
    for axes, (title, plans) in zip(panels, PANELS.items(), strict=True):
        tests = [row for plan in plans for row in read(RESULTS / plan / "curves.csv")]
        tests = [row for row in tests if row["environment"] == "medium"]
        rows = {method: [row for row in tests if row["method"] == method] for method in METHODS}
        curves = {method: curve(mine) for method, mine in rows.items() if mine}
        plot_curves(axes, curves, METHODS, title)
        axes.set_ylabel("success rate (mean; least and most)")
        shown |= set(curves)
    add_legend(panels[-1], METHODS, shown)
    save_figure(panels[0], PAGE.parent / "learning_curves.png")


if __name__ == "__main__":
    main()
