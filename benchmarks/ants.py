"""What trained ants can do: random pairs at three tolerances, the far goal of other papers, and falls.

    python -m benchmarks.ants runs/compare/ant-umaze/dsg-frontier/seed* --out benchmarks/results/ants_umaze.json

The agents are the checkpoints of ``sb3-skillgraph compare benchmarks/compare_ants.yml``. Each goes from 100 random starts to
random goals at least 2 cells of path away, as ``evaluate_pairs`` draws them; the least distance from the goal in 1000 steps
of 0.1 s tells whether it was reached within 0.45 m (the success radius), 0.6 m (the paper's) and 0.6 of a cell (2.4 m, about
what DHRL asks for: 5 m in cells of 8 m). *Far goal*: from the training start to the free cell with the longest path, 32 times.
*Floor*: from the training start to 100 goals anywhere on the floor, however near to a wall, where the body has no room.
*Straight*: the random pairs by the same agent without plans, its walker going straight on to the goal. An episode ends when
the ant is on its back. *Cells*: share of the maze's free squares of 1 m that were visited in the last 50 000 steps of
training, and by a random walk in as many (its episodes end with a fall, too).
"""

import argparse
import json
import pathlib
import shlex
import sys
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th

from sb3_skillgraph import __version__
from sb3_skillgraph.baselines import StraightOn, random_walk
from sb3_skillgraph.envs import MazeGeometry
from sb3_skillgraph.evaluation import Predictor, run_pair, sample_pairs
from sb3_skillgraph.experiments.run_folder import CONFIG, checkpoints, load_agent, read_json

TOLERANCES = {"0.45 m": 0.45, "0.6 m": 0.6, "0.6 cells": 2.4}
WALKS = ("pairs", "far", "floor", "straight")
N_PAIRS, N_FAR, N_LAST = 100, 32, 50_000


def walk(agent: Predictor, env: gym.Env, pairs: Sequence[tuple[np.ndarray | None, np.ndarray]]) -> list[dict[str, Any]]:
    """Go from starts (None: the training start) to goals; how near the ant came, after how many steps, whether it fell."""
    walks = []
    for start, goal in pairs:
        pair = run_pair(agent, env, start, goal, np.nan)
        walks.append(
            {"goal": goal.round(3).tolist(), "nearest": round(pair.nearest, 4), "steps": pair.steps, "fell": pair.stuck}
        )
    return walks


def farthest_cell(geometry: MazeGeometry) -> np.ndarray:
    """Return the middle of the free cell with the longest path from the training start."""
    start = geometry.cell_to_xy(*geometry.start_cell)
    free = [geometry.cell_to_xy(*cell) for cell in geometry.free_cells]
    return max(free, key=lambda point: geometry.shortest_path_length(start, point))


def rates(walks: list[dict[str, Any]]) -> dict[str, float]:
    """Sum up walks."""
    reached = {name: float(np.mean([walk["nearest"] <= radius for walk in walks])) for name, radius in TOLERANCES.items()}
    return {**reached, "fell": float(np.mean([walk["fell"] for walk in walks]))}


def visited_share(geometry: MazeGeometry, points: np.ndarray) -> float:
    """Return the share of the free squares of 1 m in which there are points."""
    x_min, x_max, y_min, y_max = geometry.extent
    corners = np.stack(np.meshgrid(np.arange(x_min, x_max), np.arange(y_min, y_max)), axis=-1).reshape(-1, 2)
    free = {tuple(corner) for corner in corners[geometry.is_free(corners + 0.5, 0.0)]}
    origin = np.array([x_min, y_min])
    seen = {tuple(corner) for corner in origin + np.floor(points - origin)}
    return len(free & seen) / len(free)


def test_run(folder: pathlib.Path) -> dict[str, Any]:
    """Test the newest checkpoint of a run."""
    config = read_json(folder / CONFIG)
    env = gym.make(config["env_id"], **{"terminate_on_success": True, **config["env_kwargs"]})
    saved = checkpoints(folder)
    if not saved:
        raise SystemExit(f"{folder} holds no checkpoint: name a run of sb3-skillgraph compare, which keeps its last one.")
    agent = load_agent(saved[max(saved)], env)
    geometry, margin = env.get_wrapper_attr("geometry"), env.get_wrapper_attr("body_radius")
    env.reset(seed=config["seed"])
    drawn = [pair[:2] for pair in sample_pairs(geometry, margin, N_PAIRS, config["seed"] + 1000)]
    rng = np.random.default_rng(config["seed"])
    far = [(None, farthest_cell(geometry))] * N_FAR
    floor = [(None, geometry.sample_free(rng, 0.0)) for _ in range(N_PAIRS)]
    walks = {kind: walk(agent, env, pairs) for kind, pairs in (("pairs", drawn), ("far", far), ("floor", floor))}
    store = agent.parts.store
    last = np.arange(max(store.oldest, store.total - N_LAST), store.total)
    walks["straight"] = walk(StraightOn(agent), env, drawn)
    visits = {
        "agent": visited_share(geometry, store.column("next_achieved_goal", last)),
        "random walk": visited_share(
            geometry, random_walk(gym.make(config["env_id"], **config["env_kwargs"]), config["seed"], N_LAST)
        ),
    }
    summary = {kind: rates(walked) for kind, walked in walks.items()}
    return {"seed": config["seed"], "steps": max(saved), **summary, "cells": visits, "walks": walks}


def main() -> None:
    """Test runs and write what came out."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=pathlib.Path, nargs="+")
    parser.add_argument("--out", type=pathlib.Path, required=True)
    args = parser.parse_args()
    th.set_num_threads(1)
    runs = []
    for folder in args.runs:
        runs.append(test_run(folder))
        print({name: value for name, value in runs[-1].items() if name != "walks"}, flush=True)
    means = {kind: {name: float(np.mean([run[kind][name] for run in runs])) for name in runs[0][kind]} for kind in WALKS}
    command = f"python -m benchmarks.ants {shlex.join(sys.argv[1:])}"
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(json.dumps({"command": command, "version": __version__, **means, "runs": runs}, indent=1) + "\n")


if __name__ == "__main__":
    main()
