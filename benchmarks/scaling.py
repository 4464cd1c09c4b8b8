"""What a step costs as an agent grows: with what it has visited, and with the events of its graph.

    OMP_NUM_THREADS=1 python -m benchmarks.scaling --out benchmarks/results/scaling.json

*Visited*: an agent on the toy environment whose store holds so many transitions; a learning step (mean over whole runs of
``learn``, growth and updates included), a ``predict`` while an option runs, and a decision (a plan for a new goal).
*Events*: a graph laid by hand over an open square, each event joined to the events around it; the mask of ``OptionsEnv`` (an
action for every walk), a decision, and ``plan``, which works out what it promises as well. Medians over turns; the machine's
own noise is in them.
"""

import argparse
import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch as th

from sb3_skillgraph import SkillGraphAgent
from sb3_skillgraph.choices import Start
from sb3_skillgraph.graph import MAX_DEGREE, SPACING, SkillGraph
from sb3_skillgraph.planning import Planner
from sb3_skillgraph.runner import Runner
from sb3_skillgraph.smdp.actions import WalkActions
from sb3_skillgraph.walk_model import WalkModel

TOY = "SkillGraph/ToyMaze-v0"
VISITED, EVENTS = (0, 50_000, 200_000), (50, 500, 5_000)
TRAINED, STRETCH = 3_000, 1_000  # environment steps before, and in one turn of, the measurement of learning
TURNS = 7


def milliseconds(action: Callable[[int], object], times: int) -> float:
    """Return the median over turns of what one of many calls takes."""
    turns = []
    for turn in range(TURNS):
        begin = time.perf_counter()
        for i in range(times):
            action(turn * times + i)
        turns.append((time.perf_counter() - begin) / times)
    return round(1e3 * statistics.median(turns), 4)


def with_visited(n_visited: int) -> dict[str, float]:
    """Measure an agent whose store holds so many transitions."""
    env = gym.make(TOY)
    agent = SkillGraphAgent("MultiInputPolicy", env, seed=0).learn(TRAINED, log_interval=None)
    store, rng = agent.parts.store, np.random.default_rng(0)
    for _ in range(n_visited):
        # The toy's observation and goal are positions.
        here, there, action, goal = rng.uniform(-1.5, 1.5, (4, 1, 2)).astype(np.float32)
        store.add(here, here, there, there, action, goal, np.zeros(1, bool), rng.random(1) < 0.01)
    learning = milliseconds(lambda _: agent.learn(STRETCH, log_interval=None, reset_num_timesteps=False), 1) / STRETCH
    observation, _ = env.reset(seed=0)
    _, state = agent.predict(observation)
    goals = [env.get_wrapper_attr("sample_free")(rng) for _ in range(1_000)]
    return {
        "visited": n_visited + TRAINED,
        "learning_step_ms": round(learning, 4),
        "predict_ms": milliseconds(lambda _: agent.predict(observation, state), 200),
        "decision_ms": milliseconds(lambda i: agent.predict({**observation, "desired_goal": goals[i % 1_000]}), 50),
    }


def square(n_events: int) -> Planner:
    """Lay a graph over an open square: events on a jittered grid, walks to the nearest, most of them tried."""
    rng = np.random.default_rng(0)
    side = int(np.ceil(np.sqrt(n_events)))
    graph = SkillGraph(2, 1.0, n_events)
    cells = np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 2)[:n_events]
    for cell in cells:
        graph.add_event(SPACING * (cell + rng.uniform(-0.2, 0.2, 2)), salient=False)
    graph.now = 10_000.0
    for i in range(n_events):
        near = np.argsort(graph.distances(graph.centers[i]), kind="stable")[1 : MAX_DEGREE + 1]
        for j in near.tolist():
            steps = 5.0 * float(np.linalg.norm(graph.centers[i] - graph.centers[j]))
            row = graph.edges.add(i, j, graph.now)
            graph.edges.forward[row], graph.edges.crossing_steps[row] = 3.0, steps
            for _ in range(rng.integers(0, 4)):
                graph.ran(i, j, bool(rng.random() < 0.9), i, int(steps))
    return Planner(graph, WalkModel(), 1_000)


def with_events(n_events: int) -> dict[str, float]:
    """Measure plans over a graph of so many events."""
    planner = square(n_events)
    rng = np.random.default_rng(1)
    size = SPACING * np.sqrt(n_events)
    points = rng.uniform(0.0, size, (2_000, 2, 2))

    def decide(i: int) -> None:
        here, goal = points[i]
        planner.solve(Start(here, planner.graph.locate(here)), goal)

    def plan(i: int) -> None:
        here, goal = points[i]
        start = Start(here, planner.graph.locate(here))
        solution = planner.solve(start, goal)
        planner.path(solution, solution.first())
        planner.promise(solution, solution.first(), 1_000.0)

    runner = SkillGraphAgent("MultiInputPolicy", gym.make(TOY)).parts.runner
    actions = WalkActions(Runner(planner.graph, planner, runner.actor, runner.view))

    def mask(i: int) -> None:
        here, goal = points[i].astype(np.float32)
        actions.masks({"observation": here, "achieved_goal": here, "desired_goal": goal})

    times = max(3, 2_000 // n_events)
    result = {"events": n_events, "edges": planner.graph.edges.size, "mask_ms": milliseconds(mask, 200)}
    return {**result, "decision_ms": milliseconds(decide, times), "plan_ms": milliseconds(plan, max(times // 4, 1))}


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    th.set_num_threads(1)
    document = {
        "command": f"python -m benchmarks.scaling --out {args.out}",
        "visited": [with_visited(n) for n in VISITED],
        "events": [with_events(n) for n in EVENTS],
    }
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(json.dumps(document, indent=1) + "\n")
    print(json.dumps(document, indent=1))


if __name__ == "__main__":
    main()
