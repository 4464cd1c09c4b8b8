"""The paper's figures, redrawn from stored runs."""

from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from sb3_skillgraph.agent import SkillGraphAgent
from sb3_skillgraph.baselines import random_walk
from sb3_skillgraph.envs import MazeGeometry, geometry_of
from sb3_skillgraph.experiments.plan import RunSpec
from sb3_skillgraph.experiments.run_folder import DONE, STEPS, checkpoints, load_agent, read_json, read_progress
from sb3_skillgraph.experiments.status import is_done
from sb3_skillgraph.experiments.summary import estimate
from sb3_skillgraph.experiments.testing import STRETCH
from sb3_skillgraph.hyperparams import make_recommended
from sb3_skillgraph.learning.dco import learn_fiedler
from sb3_skillgraph.plotting import paper_figures as draw

SHARES = (0.1, 0.3, 0.6, 1.0)  # of the run, at which it is looked at
N_PAIRS = 20_000


class MissingRunError(ValueError):
    """What a figure needs is not there."""


def redraw(number: int, specs: Sequence[RunSpec], out: Path) -> Axes:
    """Redraw one of the paper's figures.

    :param number: 3, 4, 5, 6 or 9; 7 and 8 show edges between skills, which there are none of yet
    :param specs: the runs it is drawn from: all of them for 5, the first that fits for the others
    :param out: folder of all runs
    :return: axes of the figure
    :raises MissingRunError: if there is no such figure or no such run
    """
    figures: dict[int, Callable[[Sequence[RunSpec], Path], Axes]] = {
        3: frontier,
        4: exploration,
        5: curves,
        6: growth,
        9: failure_of_dco,
    }
    if number not in figures:
        raise MissingRunError(f"There is no Figure {number} to redraw: it is one of {', '.join(map(str, figures))}.")
    return figures[number](specs, out)


# -- reading runs -----------------------------------------------------------------------------------------------------


def _finished(specs: Sequence[RunSpec], out: Path, salience: str | None = None, with_agent: bool = True) -> list[RunSpec]:
    """Find the finished runs of skill graphs, at least one; those whose checkpoint is still there, if it is needed."""
    found = [
        spec
        for spec in specs
        if spec.algorithm == "skill_graph"
        and (salience is None or spec.arguments.get("salience", "frontier") == salience)
        and is_done(spec, out)
    ]
    kind = "of a skill graph" if salience is None else f"of a skill graph with salience={salience}"
    if not found:
        raise MissingRunError(f"This figure needs a finished run {kind}, and {out} has none.")
    usable = [spec for spec in found if not with_agent or checkpoints(spec.folder(out))]
    if not usable:
        raise MissingRunError(f"This figure needs the agent, and no finished run {kind} in {out} has a checkpoint any more.")
    return usable


def _name(spec: RunSpec) -> str:
    return f"{spec.method}, seed {spec.seed}"


def _agent(spec: RunSpec, out: Path) -> SkillGraphAgent:
    saved = checkpoints(spec.folder(out))
    return load_agent(saved[max(saved)], make_recommended(spec.env_id, spec.env_kwargs))


def _geometry(spec: RunSpec) -> MazeGeometry | None:
    env = make_recommended(spec.env_id, spec.env_kwargs)
    geometry = geometry_of(env)
    env.close()
    return geometry


def _visits(agent: SkillGraphAgent) -> np.ndarray:
    rows = np.arange(agent.parts.store.oldest, agent.parts.store.total)
    return agent.parts.store.column("next_achieved_goal", rows)


# -- figures ----------------------------------------------------------------------------------------------------------


def frontier(specs: Sequence[RunSpec], out: Path) -> Axes:
    """Figure 3: the frontier, and the Fiedler embedding's two ends on it, as training goes on."""
    spec = _finished(specs, out)[0]
    agent, geometry = _agent(spec, out), _geometry(spec)
    panels = draw.new_panels(len(SHARES))
    visits, store = _visits(agent), agent.parts.store
    for axes, share in zip(panels, SHARES, strict=True):
        n_steps = int(share * len(visits))
        store.total = store.oldest + n_steps  # what the agent knew then
        embedding = learn_fiedler(store, agent.graph.walk_steps, N_PAIRS, np.random.default_rng(0))
        points = draw.thinned(visits[:n_steps])
        values = embedding(points)
        ends = points[[values.argmin(), values.argmax()]]
        draw.plot_frontier(axes, points, values, ends, geometry, f"{_name(spec)}, {n_steps:,} steps")
    return panels[0]


def exploration(specs: Sequence[RunSpec], out: Path) -> Axes:
    """Figure 4: where the agent has been, and where a random walk gets in the same steps."""
    spec = _finished(specs, out)[0]
    visits, geometry = _visits(_agent(spec, out)), _geometry(spec)
    walked = random_walk(make_recommended(spec.env_id, spec.env_kwargs), spec.seed, len(visits))
    panels = draw.new_panels(6, n_rows=2)
    for name, points, row in ((_name(spec), visits, panels[:3]), ("random walk", walked, panels[3:])):
        for axes, share in zip(row, (0.1, 0.4, 1.0), strict=True):
            n_steps = int(share * len(points))
            draw.plot_visits(axes, points[:n_steps], geometry, f"{name}, {n_steps:,} steps")
    return panels[0]


def curves(specs: Sequence[RunSpec], out: Path) -> Axes:
    """Figure 5: success on unseen pairs, a panel for each environment.

    Above against training steps; below, if there was a test time, against the steps that a copy learned with each pair.
    """
    labels = list(dict.fromkeys(spec.environment for spec in specs))
    by_label = [[spec for spec in specs if spec.environment == label] for label in labels]
    training = [method_curves(here, out) for here in by_label]
    if not any(training):
        raise MissingRunError(f"There are no results in {out} yet.")
    testing = [practice_curves(here, out) for here in by_label]
    methods = list(dict.fromkeys(spec.method for spec in specs))
    panels = draw.new_panels(len(labels) * (1 + any(testing)), n_rows=1 + any(testing))
    for axes, by_method, here, label in zip(panels, training, by_label, labels, strict=False):
        seeds = Counter(spec.method for spec in here if is_done(spec, out)).values()
        fewest, most = min(seeds, default=0), max(seeds, default=0)
        n_seeds = f"{most}" if fewest == most else f"{fewest} to {most}"
        draw.plot_curves(axes, by_method, methods, f"{label} ({n_seeds} seed{'s' * (most > 1)})")
    if any(testing):
        for axes, by_method, label in zip(panels[len(labels) :], testing, labels, strict=True):
            draw.plot_curves(axes, by_method, methods, f"{label}, at test time", "environment steps with the goal")
    shown = {name for by_method in training for name in by_method}
    draw.add_legend(panels[len(labels) - 1], methods, shown)
    return panels[0]


def method_curves(specs: Sequence[RunSpec], out: Path) -> dict[str, draw.Curve]:
    """Read the curves of every method on one environment; seeds that are not done yet are left out.

    All points of a curve are of the same pairs: at the end, the first of the many that are tested then.

    :param specs: runs on that environment
    :param out: folder of all runs
    """
    result = {}
    for method in dict.fromkeys(spec.method for spec in specs):
        done = [spec for spec in specs if spec.method == method and is_done(spec, out)]
        if not done:
            continue
        steps = [row[STEPS] for row in read_progress(done[0].folder(out))]
        scores = np.array([_scores(spec, spec.folder(out)) for spec in done])
        if len(steps) == 1:  # nothing to learn: the same from the beginning
            steps, scores = [0, *steps], np.repeat(scores, 2, axis=1)
        estimates = np.array([estimate(column[None]) for column in scores.T])
        result[method] = draw.Curve(np.array(steps), *estimates.T)
    return result


def _scores(spec: RunSpec, folder: Path) -> list[float]:
    scores = [float(row["eval/success_rate"]) for row in read_progress(folder)]
    pairs = read_json(folder / DONE)["pairs"][: spec.pairs]
    return [*scores[:-1], float(np.mean([pair["success"] for pair in pairs]))]


def practice_curves(specs: Sequence[RunSpec], out: Path) -> dict[str, draw.Curve]:
    """Read how success grows with the steps that copies learn with each pair.

    :param specs: runs on one environment
    :param out: folder of all runs
    """
    result = {}
    for method in dict.fromkeys(spec.method for spec in specs):
        files = [spec.folder(out) / DONE for spec in specs if spec.method == method and is_done(spec, out)]
        tests = [read_json(file)["test_time"] for file in files]
        if not tests or not tests[0]:
            continue
        scores = np.array([np.mean(pairs, axis=0) for pairs in tests])
        estimates = np.array([estimate(column[None]) for column in scores.T])
        result[method] = draw.Curve(STRETCH * np.arange(scores.shape[1]), *estimates.T)
    return result


def growth(specs: Sequence[RunSpec], out: Path) -> Axes:
    """Figure 6: the graph as it grows."""
    spec = _finished(specs, out, with_agent=False)[0]
    geometry = _geometry(spec)
    snapshots = [
        draw.GraphSnapshot(plain["steps"], np.array(plain["centers"]), [tuple(link) for link in plain["links"]])
        for plain in (read_json(path) for path in spec.folder(out).glob("graph_*.json"))
    ]
    snapshots.sort(key=lambda snapshot: snapshot.steps)
    if not snapshots:
        raise MissingRunError(f"{spec.folder(out)} has no snapshots of its graph.")
    chosen = sorted({round(share * (len(snapshots) - 1)) for share in (0.0, 0.15, 0.4, 1.0)})
    panels = draw.new_panels(len(chosen))
    for axes, index in zip(panels, chosen, strict=True):
        draw.plot_growth(axes, snapshots[index], geometry, _name(spec))
    return panels[0]


def failure_of_dco(specs: Sequence[RunSpec], out: Path) -> Axes:
    """Figure 9: where deep covering options find no events, beside the agent with another salience."""
    panels = draw.new_panels(2)
    both = [_finished(specs, out, salience) for salience in ("dco", "frontier")]
    seed = next((spec.seed for spec in both[0] if spec.seed in {other.seed for other in both[1]}), both[0][0].seed)
    for axes, runs in zip(panels, both, strict=True):
        spec = next((run for run in runs if run.seed == seed), runs[0])
        agent = _agent(spec, out)
        pairs = read_json(spec.folder(out) / DONE)["pairs"]
        missed = np.array([pair["goal"] for pair in pairs if not pair["success"]]).reshape(-1, agent.graph.goal_dim)
        centers = np.array([event.center for event in agent.events])
        title = f"{_name(spec)}:\n{len(centers)} events, {len(missed)} of {len(pairs)} goals missed"
        draw.plot_missed(axes, _visits(agent), centers, missed, _geometry(spec), title)
    return panels[0]
