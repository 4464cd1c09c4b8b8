"""The command line: ``sb3-skillgraph train | evaluate | plot | explore | export | video | demo | compare | ...``."""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, NoReturn

import gymnasium as gym
import numpy as np
import torch as th
from rich.console import Console
from rich.table import Table
from stable_baselines3.common.type_aliases import PolicyPredictor

from sb3_skillgraph.agent import SkillGraphAgent
from sb3_skillgraph.baselines import RandomWalk, StraightOn
from sb3_skillgraph.envs import geometry_of
from sb3_skillgraph.evaluation import NoPairsError, PairsResult, evaluate_pairs
from sb3_skillgraph.experiments.commands import add_compare, add_figure, add_status
from sb3_skillgraph.experiments.console import UserError, assignment, for_people, positive
from sb3_skillgraph.experiments.opening import (
    add_agent,
    add_command,
    add_env_kwargs,
    add_seed,
    check_env_id,
    find_run,
    load_agent,
    make_env,
)
from sb3_skillgraph.experiments.run_folder import EXPERIENCE
from sb3_skillgraph.experiments.training import train, write_json
from sb3_skillgraph.explore.commands import add_explore, add_export, add_video
from sb3_skillgraph.hyperparams import check_hyperparams, load_hyperparams
from sb3_skillgraph.plotting import plot_plan, plot_skill_graph, run_plan, save_figure
from sb3_skillgraph.version import __version__

DEMO_ENV, DEMO_STEPS, DEMO_PAIRS = "SkillGraph/PointMazeMedium-v0", 20_000, 100
USER_ERROR, INTERRUPTED = 2, 130


class _Parser(argparse.ArgumentParser):
    """Says in one line what is wrong with the arguments."""

    def error(self, message: str) -> NoReturn:
        self.exit(USER_ERROR, f"{self.prog}: error: {message} (see {self.prog} --help)\n")


# -- arguments ---------------------------------------------------------------------------------------------------------


def build_parser() -> argparse.ArgumentParser:
    """Build the parser of the whole command line.

    :return: the parser; the chosen command is the attribute ``run`` of what it parses
    """
    parser = _Parser(
        prog="sb3-skillgraph",
        description="Deep Skill Graphs: learn skills without reward, plan over them to goals never trained on.",
    )
    parser.add_argument("--version", action="version", version=__version__)
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    _add_train(commands)
    _add_evaluate(commands)
    _add_plot(commands)
    _add_demo(commands)
    add_compare(commands)
    add_status(commands)
    add_figure(commands)
    add_explore(commands)
    add_export(commands)
    add_video(commands)
    return parser


def _add_train(commands: Any) -> None:
    command = add_command(
        commands,
        "train",
        _train,
        "Train an agent on a goal environment, without reward.",
        "Arguments of the agent come from its signature, then from the environment's entry in hyperparams/*.yml, then\n"
        "from --hyperparams. OUT receives agent.zip, experience.zip (what it has met, for evaluate --adapt), progress.csv\n"
        "and config.json. Ctrl-C saves the agent, too. However it was interrupted, the same command goes on from the last\n"
        "checkpoint, and comes to the same as in one go (of environments that tell their state, as SkillGraph/* do); with\n"
        "more --steps it trains a finished agent further.\n\n"
        "example:\n  sb3-skillgraph train SkillGraph/PointMazeUMaze-v0 --steps 50000 --out runs/umaze\n"
        "  sb3-skillgraph train SkillGraph/ToyMaze-v0 --hyperparams salience=rrt policy_kwargs='{net_arch: [64, 64]}'",
    )
    add_seed(command)
    command.add_argument("env", metavar="ENV", help="environment id; 'package:Name-v0' imports the package first")
    command.add_argument("--steps", type=positive, help="environment steps (default: the environment's entry)")
    command.add_argument("--out", type=Path, help="folder for the results (default: runs/<environment>-seed<seed>)")
    command.add_argument("--n-envs", type=positive, default=1, help="copies of the environment (default: 1)")
    command.add_argument("--device", default="auto", help="torch device: auto, cpu, cuda (default: auto)")
    command.add_argument("--verbose", action="store_true", help="print SB3's table, too")
    command.add_argument("--tensorboard", action="store_true", help="write a log for TensorBoard into the folder, too")
    command.add_argument(
        "--hyperparams-of",
        metavar="ENV",
        help="begin with the entry of another environment: SkillGraph/AntUMaze-v0 for an ant of your own (which may need "
        "event_radius and option_view in --hyperparams, too)",
    )
    command.add_argument(
        "--hyperparams",
        nargs="+",
        type=assignment,
        default=[],
        metavar="NAME=VALUE",
        help="arguments of SkillGraphAgent, values in YAML",
    )
    add_env_kwargs(command)


def _add_evaluate(commands: Any) -> None:
    command = add_command(
        commands,
        "evaluate",
        _evaluate,
        "Measure how often a trained agent gets from a random start to a random goal of a maze.",
        "With --adapt, a copy of the agent first learns for so many steps with each goal (few-shot), also from the\n"
        "experience.zip of the run.\n\n"
        "example:\n  sb3-skillgraph evaluate runs/umaze --pairs 100",
    )
    add_seed(command)
    add_agent(command)
    command.add_argument("--pairs", type=positive, default=100, help="pairs of start and goal (default: 100)")
    command.add_argument("--adapt", type=positive, default=0, metavar="STEPS", help="steps of adaptation per pair")
    command.add_argument("--straight-on", action="store_true", help="without plans: the walker goes straight on to every goal")
    command.add_argument("--out", type=Path, metavar="FILE.json", help="write every pair to this file")


def _add_plot(commands: Any) -> None:
    command = add_command(
        commands,
        "plot",
        _plot,
        "Draw an agent's skill graph, and one plan as it is executed.",
        "OUT receives skill_graph.png and plan.png; --seed chooses start and goal of the plan.\n\n"
        "example:\n  sb3-skillgraph plot runs/umaze --out runs/umaze",
    )
    add_seed(command)
    add_agent(command)
    command.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the pictures")


def _add_demo(commands: Any) -> None:
    command = add_command(
        commands,
        "demo",
        _demo,
        f"Train on {DEMO_ENV}, evaluate random pairs of start and goal, and draw pictures.",
        "The table compares the agent, the same walker sent straight on to every goal, and a random walk. OUT receives\n"
        "agent.zip, experience.zip, progress.csv, config.json, results.json, skill_graph.png and plan.png. A minute on\n"
        "one core.\n\n"
        "example:\n  sb3-skillgraph demo --out runs/demo",
    )
    add_seed(command)
    command.add_argument("--steps", type=positive, default=DEMO_STEPS, help=f"environment steps (default: {DEMO_STEPS})")
    command.add_argument("--pairs", type=positive, default=DEMO_PAIRS, help=f"pairs of start and goal (default: {DEMO_PAIRS})")
    command.add_argument("--out", type=Path, default=Path("runs/demo"), help="folder for the results (default: runs/demo)")


# -- commands ----------------------------------------------------------------------------------------------------------


def _train(args: argparse.Namespace) -> int:
    check_env_id(args.env)
    out = args.out or Path("runs") / f"{args.env.rpartition('/')[2]}-seed{args.seed}"
    with for_people():
        given = check_hyperparams(dict(args.hyperparams), "--hyperparams")
        recommended = load_hyperparams(args.hyperparams_of or args.env, required=bool(args.hyperparams_of))
        hyperparams = {**recommended, **given}
    n_timesteps = int(hyperparams.pop("n_timesteps"))
    env_kwargs, steps = dict(args.env_kwargs), args.steps or n_timesteps
    if hyperparams.pop("tensorboard_log", None) is not None:
        raise UserError("tensorboard_log is not for --hyperparams: --tensorboard writes the log into OUT.")
    train(args.env, env_kwargs, hyperparams, steps, args.seed, out, args.n_envs, args.device, args.verbose, args.tensorboard)
    return 0


def _evaluate(args: argparse.Namespace) -> int:
    path, env_id, env_kwargs = find_run(args)
    if args.out is not None and args.out.is_dir():
        raise UserError(f"{args.out} is a folder: --out names a file for the pairs, such as {args.out / 'pairs.json'}.")
    env = make_env(env_id, env_kwargs)
    try:
        agent = load_agent(path, env)
        if args.adapt:
            _load_experience(agent, path.with_name(EXPERIENCE))
        if args.straight_on and args.adapt:
            raise UserError("--straight-on and --adapt do not go together: only the agent itself adapts.")
        tested = StraightOn(agent) if args.straight_on else agent
        drawn = dict(n_pairs=args.pairs, seed=args.seed, adapt_timesteps=args.adapt)
        result = evaluate_pairs(tested, env, progress_bar=True, **drawn)
    except NoPairsError as error:
        raise UserError(str(error)) from error
    finally:
        env.close()
    _print_table(env_id, {str(args.agent): result})
    if args.out is not None:
        write_json(args.out, _as_plain(result))
        print(f"every pair is in {args.out}")
    return 0


def _plot(args: argparse.Namespace) -> int:
    path, env_id, env_kwargs = find_run(args)
    env = make_env(env_id, env_kwargs)
    try:
        agent = load_agent(path, env)
        env.reset(seed=args.seed)
        _draw(agent, env, args.out)
    finally:
        env.close()
    return 0


def _demo(args: argparse.Namespace) -> int:
    print(f"Learning {DEMO_ENV} for {args.steps} steps without reward; then {args.pairs} random pairs of start and goal.")
    hyperparams = load_hyperparams(DEMO_ENV)
    del hyperparams["n_timesteps"]
    agent = train(DEMO_ENV, {}, hyperparams, args.steps, args.seed, args.out)
    assert isinstance(agent.action_space, gym.spaces.Box)
    methods: dict[str, PolicyPredictor] = {
        "skill graph": agent,
        "walker, straight on": StraightOn(agent),
        "random walk": RandomWalk(agent.action_space, args.seed),
    }
    results = {name: evaluate_pairs(method, DEMO_ENV, n_pairs=args.pairs, seed=args.seed) for name, method in methods.items()}
    _print_table(DEMO_ENV, results)
    write_json(args.out / "results.json", {name: _as_plain(result) for name, result in results.items()})
    # The longest way that succeeded shows the most; failing all, the longest.
    shown = max(results["skill graph"].pairs, key=lambda pair: (pair.success, pair.path_length))
    env = make_env(DEMO_ENV, {})
    try:
        _draw(agent, env, args.out, shown.start, shown.goal)
    finally:
        env.close()
    print(f"everything is in {args.out}")
    return 0


# -- what the commands share -------------------------------------------------------------------------------------------


def _load_experience(agent: SkillGraphAgent, path: Path) -> None:
    try:
        agent.load_replay_buffer(path)
    except (ValueError, OSError) as error:  # none there, or that of several environments
        print(f"the agent adapts without what it met in training: {error}")


def _draw(
    agent: SkillGraphAgent, env: gym.Env, out: Path, start: np.ndarray | None = None, goal: np.ndarray | None = None
) -> None:
    geometry = geometry_of(env)
    save_figure(plot_skill_graph(agent, geometry), out / "skill_graph.png")
    trajectory, plan = run_plan(agent, env, start, goal)
    save_figure(plot_plan(agent, geometry, trajectory, plan), out / "plan.png")
    print(f"the pictures are {out / 'skill_graph.png'} and {out / 'plan.png'}")


def _mean_steps(result: PairsResult) -> float | None:
    steps = [pair.steps for pair in result.pairs if pair.success]
    return float(np.mean(steps)) if steps else None


def _print_table(title: str, results: dict[str, PairsResult]) -> None:
    n_pairs = len(next(iter(results.values())).pairs)
    table = Table(title=f"{title}: {n_pairs} random pairs of start and goal")
    table.add_column("")
    for column in ("goals reached", "95 % interval", "mean steps there"):
        table.add_column(column, justify="right")
    for name, result in results.items():
        low, high = result.interval
        steps = _mean_steps(result)
        table.add_row(name, f"{result.success_rate:.0%}", f"{low:.0%} to {high:.0%}", "-" if steps is None else f"{steps:.0f}")
    Console().print(table)


def _as_plain(result: PairsResult) -> dict[str, Any]:
    return {
        "success_rate": result.success_rate,
        "interval": result.interval,
        "mean_steps": _mean_steps(result),
        "pairs": [
            {
                **pair._asdict(),
                "start": pair.start.tolist(),
                "goal": pair.goal.tolist(),
                "trace": None if pair.trace is None else asdict(pair.trace),
            }
            for pair in result.pairs
        ],
    }


def main(argv: Sequence[str] | None = None) -> int:
    """
    Run a command.

    :param argv: arguments; None for those of the process
    :return: exit code: 0, 2 for something the user can put right, 130 after Ctrl-C
    """
    args = build_parser().parse_args(argv)
    th.set_num_threads(1)  # networks this small are faster so, and other cores are free for other runs
    try:
        return int(args.run(args))
    except KeyboardInterrupt:
        print("sb3-skillgraph: interrupted", file=sys.stderr)
        return INTERRUPTED
    except (UserError, OSError) as error:
        print(f"sb3-skillgraph: error: {' '.join(str(error).split())}", file=sys.stderr)
        return USER_ERROR
