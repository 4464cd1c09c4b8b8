"""The commands ``explore``, ``export`` and ``video``."""

import argparse
import os
import socket
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym

from sb3_skillgraph.envs import geometry_of
from sb3_skillgraph.experiments.console import UserError, for_people, positive
from sb3_skillgraph.experiments.opening import add_agent, add_command, add_seed, find_run, load_agent, make_env
from sb3_skillgraph.experiments.run_folder import read_json
from sb3_skillgraph.explore.export import export
from sb3_skillgraph.explore.video import record

PORT = 8080


def add_explore(commands: Any) -> None:
    """Add ``explore``.

    :param commands: argparse's sub-parsers
    """
    command = add_command(
        commands,
        "explore",
        _explore,
        "Show an agent on a page of this machine: click a place and watch it plan and go.",
        "The page is for this machine only (127.0.0.1), and needs the extra 'explore'. It shows the graph, what is known of\n"
        "its events and options, plans as sentences and lines, and runs of them beside what was promised.\n\n"
        "example:\n  sb3-skillgraph explore examples/agents/point_medium",
    )
    add_agent(command)
    command.add_argument("--port", type=positive, default=PORT, help=f"port on 127.0.0.1 (default: {PORT})")
    command.add_argument("--no-browser", action="store_true", help="do not open a browser")


def add_export(commands: Any) -> None:
    """Add ``export``.

    :param commands: argparse's sub-parsers
    """
    command = add_command(
        commands,
        "export",
        _export,
        "Write an agent's skill graph for other programs, or as one page that needs no network.",
        "The ending of OUT tells what: .graphml (yEd, Gephi, Cytoscape), .json (networkx's node-link data), .html.\n\n"
        "example:\n  sb3-skillgraph export runs/umaze --out umaze.graphml",
    )
    add_agent(command)
    command.add_argument("--out", type=Path, required=True, metavar="FILE", help="file.graphml, file.json or file.html")


def add_video(commands: Any) -> None:
    """Add ``video``.

    :param commands: argparse's sub-parsers
    """
    command = add_command(
        commands,
        "video",
        _video,
        "Film a plan as it is followed, in any environment that renders, the plan beside it.",
        "The ending of OUT tells what: .mp4 (needs the package imageio-ffmpeg) or .gif. --seed chooses start and goal.\n\n"
        "example:\n  sb3-skillgraph video runs/umaze --out umaze.gif",
    )
    add_agent(command)
    add_seed(command)
    command.add_argument("--out", type=Path, required=True, metavar="FILE", help="file.mp4 or file.gif")


def rendered(env_id: str, env_kwargs: dict[str, Any]) -> gym.Env:
    """Make an environment that returns pictures, if it can.

    :param env_id: its id
    :param env_kwargs: its keyword arguments
    """
    if sys.platform == "linux" and not os.environ.get("DISPLAY"):
        os.environ.setdefault("MUJOCO_GL", "egl")  # MuJoCo's own choice is a window
    try:
        return make_env(env_id, {**env_kwargs, "render_mode": "rgb_array"})
    except UserError:  # it knows of no such argument
        return make_env(env_id, env_kwargs)


def _explore(args: argparse.Namespace) -> int:
    try:
        from sb3_skillgraph.explore import page
    except ImportError as error:
        raise UserError(f"explore needs the package {error.name}: pip install 'sb3_skillgraph[explore]'.") from error
    _check_port(page.HOST, args.port)
    path, env_id, env_kwargs = find_run(args)
    agent = load_agent(path, rendered(env_id, env_kwargs))
    with for_people():
        snapshots = [read_json(file) for file in path.parent.glob("graph_*.json")]
    snapshots.sort(key=lambda snapshot: snapshot["steps"])
    shown = page.Shown(agent, lambda: rendered(env_id, env_kwargs), snapshots, f"{env_id}: {path.parent.name}")
    page.serve(shown, args.port, not args.no_browser)
    return 0


def _check_port(host: str, port: int) -> None:
    with socket.socket() as tried:
        tried.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            tried.bind((host, port))
        except (OSError, OverflowError) as error:
            raise UserError(f"port {port} cannot be had ({error}): choose another one with --port.") from error


def _export(args: argparse.Namespace) -> int:
    path, env_id, env_kwargs = find_run(args)
    env = make_env(env_id, env_kwargs)
    try:
        with for_people():
            export(load_agent(path, env), args.out, geometry_of(env), title=env_id)
    finally:
        env.close()
    print(f"the graph is {args.out}")
    return 0


def _video(args: argparse.Namespace) -> int:
    path, env_id, env_kwargs = find_run(args)
    env = rendered(env_id, env_kwargs)
    try:
        with for_people():
            happened = record(load_agent(path, env), env, args.out, args.seed)
    finally:
        env.close()
    print(f"{happened}; the video is {args.out}")
    return 0
