"""Damaged and hostile files: they are refused with a ValueError, or what they hold predicts and learns.

    python -m tests.fuzz --n 5000 --kind agent      # or replay, parameters; --first to go on from a number

Every mutation is a function of its number. They run in processes of their own, in which nothing may be executed, opened for
writing or imported from outside, memory and time are limited, and a crash is noticed.
"""

import argparse
import io
import json
import multiprocessing
import os
import resource
import signal
import sys
import time
import traceback
import warnings
import zipfile
from collections import Counter
from typing import Any

import gymnasium as gym
import numpy as np

TOY = "SkillGraph/ToyMaze-v0"
KINDS = ("agent", "replay", "parameters")
#: Seconds that a file may take, and bytes that it may take beside what the process has.
SECONDS, MEMORY = 10, 300 * 2**20
LEARN_STEPS = 200
_FORBIDDEN = (
    "exec",
    "os.system",
    "os.exec",
    "os.posix_spawn",
    "os.spawn",
    "subprocess.Popen",
    "socket.connect",
    "shutil.rmtree",
)


class Forbidden(BaseException):
    """A file made the process do what it must not."""


# -- files -------------------------------------------------------------------------------------------------------------


def originals() -> dict[str, bytes]:
    """Return the files of a small agent."""
    from sb3_skillgraph import SkillGraphAgent

    small = dict(policy_kwargs=dict(net_arch=[8, 8]), learning_starts=50, batch_size=16, buffer_size=2_000)
    agent = SkillGraphAgent("MultiInputPolicy", gym.make(TOY, max_steps=60), seed=0, **small).learn(500)
    files = {}
    for kind, save in (("agent", agent.save), ("replay", agent.save_replay_buffer)):
        file = io.BytesIO()
        save(file)  # type: ignore[operator]
        files[kind] = file.getvalue()
    return {**files, "parameters": files["agent"]}


def members(data: bytes) -> dict[str, bytes]:
    """Return what is in a file, by name."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def packed(contents: dict[str, bytes], compression: int = zipfile.ZIP_STORED) -> bytes:
    """Return a file with these members."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", compression) as archive:
        for name, content in contents.items():
            archive.writestr(name, content)
    return file.getvalue()


# -- mutations ---------------------------------------------------------------------------------------------------------


def mutated(data: bytes, seed: int) -> tuple[str, bytes]:
    """Return a damaged file, and what was done to it.

    :param data: a whole file
    :param seed: number of the mutation
    """
    rng = np.random.default_rng(seed)
    how = rng.choice([mutate_leaf, mutate_leaf, mutate_leaf, mutate_array, mutate_array, mutate_bytes, mutate_members])
    what, result = how(data, rng)
    return f"{seed}: {what}", result


def mutate_bytes(data: bytes, rng: np.random.Generator) -> tuple[str, bytes]:
    """Change, cut or insert bytes."""
    raw = bytearray(data)
    kind = rng.integers(4)
    if kind == 0:
        for i in rng.integers(len(raw), size=rng.integers(1, 20)).tolist():
            raw[i] ^= int(rng.integers(1, 256))
        return "bytes changed", bytes(raw)
    if kind == 1:
        return "cut off", bytes(raw[: rng.integers(len(raw))])
    i, j = sorted(rng.integers(len(raw), size=2).tolist())
    if kind == 2:
        return "cut out", bytes(raw[:i] + raw[j:])
    return "inserted", bytes(raw[:i] + rng.bytes(int(rng.integers(1, 5_000))) + raw[i:])


def mutate_members(data: bytes, rng: np.random.Generator) -> tuple[str, bytes]:
    """Drop, rename, deflate, exchange or blow up members."""
    contents = members(data)
    names = list(contents)
    one, other = (names[i] for i in rng.integers(len(names), size=2).tolist())
    kind = rng.integers(6)
    if kind == 0:
        contents.pop(one)
        return f"without {one}", packed(contents)
    if kind == 1:
        contents["../" + one] = contents.pop(one)
        return f"renamed {one}", packed(contents)
    if kind == 2:
        contents[one], contents[other] = contents[other], contents[one]
        return f"exchanged {one} and {other}", packed(contents)
    if kind == 3:
        return "deflated", packed(contents, zipfile.ZIP_DEFLATED)
    if kind == 4:
        contents["arrays/bomb.npy"] = npy_header("<f8", (2**40,))
        return "a header that promises terabytes", packed(contents)
    contents["arrays/zeros.npy"] = npy_header("<f8", (2**26,)) + bytes(2**29)
    return "half a gigabyte of zeros", packed(contents, zipfile.ZIP_DEFLATED)


def npy_header(dtype: str, shape: tuple[int, ...]) -> bytes:
    """Return the head of an array's member."""
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"descr": dtype, "fortran_order": False, "shape": shape})
    return file.getvalue()


def leaves(tree: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Return the paths of everything in a tree that is no container, and of the containers."""
    children: list[Any] = list(tree) if isinstance(tree, dict) else list(range(len(tree))) if isinstance(tree, list) else []
    return [path, *(found for child in children for found in leaves(tree[child], (*path, child)))]


def mutate_leaf(data: bytes, rng: np.random.Generator) -> tuple[str, bytes]:
    """Put something else in one place of the JSON, or take it away."""
    contents = members(data)
    document = json.loads(contents["agent.json"])
    paths = [path for path in leaves(document) if path]
    numbers = [path for path in paths if "python" in path]  # the 625 numbers of Python's generator
    paths = [path for path in paths if "python" not in path] + numbers[:3]
    path = paths[rng.integers(len(paths))]
    parent = document
    for key in path[:-1]:
        parent = parent[key]
    old = parent[path[-1]]
    wrong = (
        None,
        -1,
        0,
        1,
        3,
        7.5,
        1e308,
        -1e308,
        float("nan"),
        float("inf"),
        10**20,
        2**31,
        True,
        "",
        "e1",
        "../x",
        [],
        {},
        [[]],
    )
    kind = rng.integers(len(wrong) + 4)
    if kind < len(wrong):
        parent[path[-1]] = wrong[kind]
    elif kind == len(wrong):
        del parent[path[-1]]
    elif kind == len(wrong) + 1 and isinstance(old, int | float):
        parent[path[-1]] = old * int(rng.choice([-1, 2, 1_000])) + int(rng.integers(-2, 3))
    elif kind == len(wrong) + 2 and isinstance(old, list):
        parent[path[-1]] = old[: rng.integers(len(old) + 1)] if rng.integers(2) else old + old[:1]
    else:
        parent[path[-1]] = {"__array__": ["<f8", 0, [2, 2]]}
    contents["agent.json"] = json.dumps(document).encode()
    return (
        f"{'/'.join(map(str, path))}: {str(old)[:40]!r} -> {str(parent[path[-1]])[:40] if kind != len(wrong) else 'gone'}",
        packed(contents),
    )


def mutate_array(data: bytes, rng: np.random.Generator) -> tuple[str, bytes]:
    """Put wrong numbers into one of the arrays that the JSON speaks of."""
    contents = members(data)
    document = json.loads(contents["agent.json"])
    places = [path for path in leaves(document) if path and path[-1] in ("__array__", "__tensor__")]
    path = places[rng.integers(len(places))]
    place: Any = document
    for key in path:
        place = place[key]
    dtype, start, shape = place
    size = int(np.prod(shape))
    name = f"arrays/{dtype[1:]}.npy"
    array = np.lib.format.read_array(io.BytesIO(contents[name]), allow_pickle=False).copy()
    if size == 0:
        return mutate_leaf(data, rng)
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        wrong: list[Any] = [-1, 0, 2**31, 10**6, np.nan, np.inf, -np.inf, 1e300] if array.dtype.kind in "fiu" else [""]
        number = np.array(wrong[rng.integers(len(wrong))]).astype(array.dtype)
    where = slice(None) if rng.integers(3) == 0 else rng.integers(size, size=rng.integers(1, 4))
    part = array[start : start + size]
    part[where] = number
    file = io.BytesIO()
    np.lib.format.write_array(file, array, allow_pickle=False)
    contents[name] = file.getvalue()
    return f"{'/'.join(map(str, path))}: {number}", packed(contents)


# -- trying them out ---------------------------------------------------------------------------------------------------


def attempt(kind: str, data: bytes, whole: dict[str, bytes], learn_steps: int) -> str:
    """Load a file, and use what it holds.

    :return: ``refused`` or ``works``
    :raises Exception: if it does neither
    """
    from sb3_skillgraph import SkillGraphAgent

    env = gym.make(TOY, max_steps=60)
    if kind == "agent":
        try:
            agent = SkillGraphAgent.load(io.BytesIO(data), env=env)
        except ValueError:
            return "refused"
        agent.verbose = 0
    else:
        agent = SkillGraphAgent.load(io.BytesIO(whole["agent"]), env=env)
        load = agent.load_replay_buffer if kind == "replay" else agent.set_parameters
        try:
            load(io.BytesIO(data))  # type: ignore[operator]
        except ValueError:
            return "refused"
        except RuntimeError:  # of SB3's set_parameters
            if kind == "replay":
                raise
            return "refused"
    observation, _ = env.reset(seed=0)
    state = None
    for _ in range(20):
        action, state = agent.predict(observation, state)
        if not (np.isfinite(action).all() and env.action_space.contains(action)):
            raise AssertionError(f"an action of {action}")
        observation = env.step(action)[0]
    agent.plan(observation)
    if learn_steps:
        agent.learn(learn_steps, log_interval=None, reset_num_timesteps=False)
    return "works"


def guard(event: str, arguments: tuple[Any, ...]) -> None:
    """An audit hook: nothing is executed, nothing is written."""
    if event in _FORBIDDEN and not _is_the_librarys(event):
        raise Forbidden(f"{event} {arguments}")
    if event == "open" and isinstance(arguments[1], str) and set(arguments[1]) & set("wax+") and arguments[0] != "/dev/null":
        raise Forbidden(f"open {arguments}")


def _is_the_librarys(event: str) -> bool:
    """Code that imports, or makes named tuples, executes its own; what a file holds never gets there."""
    frame = sys._getframe()
    while frame is not None:
        if "importlib" in frame.f_code.co_filename or frame.f_code.co_filename.startswith("<frozen"):
            return event == "exec"
        frame = frame.f_back  # type: ignore[assignment]
    return False


def memory() -> int:
    """Return the bytes that the process takes."""
    with open("/proc/self/statm") as file:
        return int(file.read().split()[0]) * resource.getpagesize()


def work(kind: str, whole: dict[str, bytes], numbers: list[int], learn_steps: int, pipe: Any) -> None:
    """Try mutations in a process of its own, and tell of each what came of it."""
    warnings.simplefilter("ignore")
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    attempt(kind, whole[kind], whole, learn_steps)  # what is imported when it is used is there now
    sys.addaudithook(guard)

    def too_long(*_: Any) -> None:
        raise TimeoutError(f"more than {SECONDS} s")

    signal.signal(signal.SIGALRM, too_long)
    for number in numbers:
        what, data = mutated(whole[kind], number)
        pipe.send((number, what, "begun"))
        signal.alarm(SECONDS)
        resource.setrlimit(resource.RLIMIT_AS, (memory() + MEMORY, resource.RLIM_INFINITY))
        try:
            outcome = attempt(kind, data, whole, learn_steps)
        except BaseException as error:  # whatever it is, it is what we look for
            last = traceback.extract_tb(error.__traceback__)[-1]
            outcome = f"{type(error).__name__}: {str(error)[:150]} ({os.path.basename(last.filename)}:{last.lineno})"
        finally:
            signal.alarm(0)
            resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
        pipe.send((number, what, outcome))
    pipe.close()


def run(kind: str, numbers: list[int], learn_steps: int = LEARN_STEPS) -> tuple[Counter[str], list[str]]:
    """Try mutations.

    :param kind: of file
    :param numbers: which mutations
    :param learn_steps: steps that what loads is to learn for
    :return: how often what came of it, and a line for everything that must not be
    """
    whole, counts, failures = originals(), Counter[str](), []
    context = multiprocessing.get_context("spawn")  # a fork of torch may hang
    left = list(numbers)
    while left:
        ours, theirs = context.Pipe(duplex=False)
        process = context.Process(target=work, args=(kind, whole, left, learn_steps, theirs))
        process.start()
        theirs.close()
        begun = ("?", "before the first")
        while True:
            if not ours.poll(6 * SECONDS):  # stuck where no signal is heard
                process.kill()
                break
            try:
                number, what, outcome = ours.recv()
            except EOFError:
                break
            begun = (number, what)
            if outcome == "begun":
                continue
            left.remove(number)
            counts[outcome if outcome in ("refused", "works") else outcome.partition(":")[0]] += 1
            if outcome not in ("refused", "works"):
                failures.append(f"{what}\n    {outcome}")
        process.join()
        if process.exitcode:
            counts["crash"] += 1
            failures.append(f"{begun[1]}\n    the process ended with {process.exitcode}")
            if begun[0] not in left:
                raise RuntimeError(f"The worker cannot be started: {begun}, {process.exitcode}.")
            left.remove(begun[0])
    return counts, failures


def main() -> int:
    """Try many mutations, and print what must not be."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--n", type=int, default=5_000)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--kind", choices=KINDS, default="agent")
    parser.add_argument("--learn-steps", type=int, default=LEARN_STEPS)
    args = parser.parse_args()
    begin = time.perf_counter()
    counts, failures = run(args.kind, list(range(args.first, args.first + args.n)), args.learn_steps)
    print("\n".join(failures))
    print(f"{args.n} files of kind {args.kind} in {time.perf_counter() - begin:.0f} s: {dict(counts)}")
    return int(bool(failures))


if __name__ == "__main__":
    sys.exit(main())
