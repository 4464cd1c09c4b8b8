"""The floors of the house: a module imports only from below its own floor, or from inside its own package."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

import sb3_skillgraph

PACKAGE = "sb3_skillgraph"
ROOT = Path(sb3_skillgraph.__file__).parent

#: Module or package -> floor. A package's modules live on the floor of the package unless named themselves.
FLOORS: dict[str, float] = {
    "version": 0,  # a constant
    "interrupts": 0,
    "rules": 0,  # numbers
    "vec_env": 0,
    "generators": 0,
    "calibration": 0,
    "metric_parts": 0.05,
    "metric": 0.1,  # knows how large numbers may be
    "events": 0.5,
    "checking": 0,
    "files": 0,
    "schema": 9.2,  # what a file may hold
    "saving": 0.5,  # writes the version
    "envs": 1,
    "memory": 2,
    "options": 3,  # initiation sets, policies, termination sets
    "goal_env": 3.5,  # what an environment tells, its view of options among it
    "edges": 3,  # records of runs, as arrays
    "digraph": 3.5,  # a picture of them
    "graph": 4,
    "walk_model": 5,
    "choices": 5,
    "choice_model": 6,
    "planning": 7,
    "running": 7.5,  # which options run, and have run
    "runner": 8,
    "plan": 9,  # the runner's plans for people to read
    "learning": 9,
    "arguments": 9.5,  # the agent's, checked
    "parts": 10,  # how all of these are put together
    "persistence": 9.3,
    "paper": 10.5,  # what PAPER does instead
    "agent": 11,
    "smdp": 11,  # on options, not on the agent
    "callbacks": 12,
    "hyperparams": 12,
    "evaluation": 12.5,  # in what is recommended for an environment
    "baselines": 13,
    "plotting": 13,
    "experiments": 14,
    "explore": 14.5,
    "cli": 15,
    "zoo": 15,
    "__main__": 16,
    "__init__": 16,
}

FILES = sorted(ROOT.rglob("*.py"))
NAMES = ["/".join(path.relative_to(ROOT).parts) for path in FILES]


def room(path: Path) -> str:
    """The first part of a module's name below the package: a package's own name, or the module's."""
    return path.relative_to(ROOT).parts[0].removesuffix(".py")


def parse(path: Path) -> ast.Module:
    return ast.parse(path.read_text(), filename=str(path))


def rooms_of(module: str, names: list[str]) -> list[str]:
    """The rooms that ``from module import names`` enters; the package itself counts as its ``__init__``."""
    parts = module.split(".")
    if len(parts) > 1:
        return [parts[1]]
    return [name if name in FLOORS and name != "__init__" else "__init__" for name in names] or ["__init__"]


def imported_rooms(path: Path, tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Lines and the rooms of the package that they import, wherever in the file the import stands."""
    package = [PACKAGE, *path.relative_to(ROOT).parts[:-1]]
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                if alias.name.split(".")[0] == PACKAGE:
                    yield from ((node.lineno, name) for name in rooms_of(alias.name, []))
        elif isinstance(node, ast.ImportFrom):
            module = node.module or ""
            if node.level:
                module = ".".join([*package[: len(package) - node.level + 1], *([module] if module else [])])
            if module.split(".")[0] == PACKAGE:
                yield from ((node.lineno, name) for name in rooms_of(module, [alias.name for alias in node.names]))


def breaches(path: Path, tree: ast.Module) -> list[str]:
    here = room(path)
    inside = path.parent != ROOT or path.name != f"{here}.py"  # in a package: its own modules may be imported
    return [
        f"line {line}: {here} (floor {FLOORS[here]}) imports {other} (floor {FLOORS.get(other)})"
        for line, other in imported_rooms(path, tree)
        if not (inside and other == here) and not FLOORS.get(other, 99.0) < FLOORS[here]
    ]


def test_every_module_has_a_floor_and_every_floor_a_module() -> None:
    assert {room(path) for path in FILES} == FLOORS.keys()


@pytest.mark.parametrize("path", FILES, ids=NAMES)
def test_imports_come_from_lower_floors(path: Path) -> None:
    assert breaches(path, parse(path)) == []


@pytest.mark.parametrize(
    ("file", "source", "n_breaches"),
    [
        ("graph.py", "from sb3_skillgraph.planning import Planner", 1),
        ("graph.py", "from .planning import Planner", 1),
        ("graph.py", "from . import planning, events", 1),
        ("graph.py", "import sb3_skillgraph.agent", 1),
        ("graph.py", "import sb3_skillgraph", 1),
        ("graph.py", "from sb3_skillgraph import SkillGraphAgent", 1),
        ("graph.py", "from sb3_skillgraph.walk_model import WalkModel", 1),
        ("graph.py", "def f():\n    from sb3_skillgraph.agent import SkillGraphAgent", 1),
        ("graph.py", "from sb3_skillgraph.options.option import Option\nimport networkx", 0),
        ("options/env.py", "from sb3_skillgraph.options.option import Option\nfrom .views import VIEWS", 0),
        ("options/env.py", "from ..graph import SkillGraph", 1),
        ("options/env.py", "from ..events import Event", 0),
        ("learning/rollout.py", "from sb3_skillgraph.plan import Plan", 1),
        ("runner.py", "from sb3_skillgraph.memory.replay import TransitionStore", 0),
    ],
)
def test_the_check_itself(file: str, source: str, n_breaches: int) -> None:
    assert len(breaches(ROOT / file, ast.parse(source))) == n_breaches


# -- what no file may do ----------------------------------------------------------------------------------------------

UNPICKLERS = {"pickle", "cloudpickle", "dill", "joblib", "shelve", "marshal"}


def unpickling(tree: ast.Module) -> list[str]:
    found = []
    for node in ast.walk(tree):
        modules: list[str] = []
        if isinstance(node, ast.Import):
            modules = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            modules = [node.module or ""]
        found += [f"line {node.lineno}: {m}" for m in modules if m.split(".")[0] in UNPICKLERS]
        if not isinstance(node, ast.Call):
            continue
        called = ast.unparse(node.func)
        if called in ("th.load", "torch.load"):
            found.append(f"line {node.lineno}: {called}")
        for keyword in node.keywords:
            setting = f"{keyword.arg}={ast.unparse(keyword.value)}"
            if setting in ("allow_pickle=True", "weights_only=False"):
                found.append(f"line {node.lineno}: {setting}")
    return found


def thread_settings(tree: ast.Module) -> list[str]:
    setters = ("set_num_threads", "set_num_interop_threads")
    return [
        f"line {node.lineno}: {ast.unparse(node)}"
        for node in ast.walk(tree)
        if (isinstance(node, ast.Attribute) and node.attr in setters)
        or (isinstance(node, ast.Constant) and node.value in ("OMP_NUM_THREADS", "MKL_NUM_THREADS"))
    ]


@pytest.mark.parametrize("path", FILES, ids=NAMES)
def test_nothing_unpickles(path: Path) -> None:
    # Many runs on disk go to joblib's workers; that is no reading of files.
    found = [line for line in unpickling(parse(path)) if room(path) != "experiments" or "joblib" not in line]
    assert found == []


@pytest.mark.parametrize("path", FILES, ids=NAMES)
def test_nothing_but_the_command_line_sets_threads(path: Path) -> None:
    if room(path) not in ("cli", "experiments"):
        assert thread_settings(parse(path)) == []
    on_import = [node for node in parse(path).body if not isinstance(node, ast.FunctionDef | ast.ClassDef)]
    assert thread_settings(ast.Module(on_import, [])) == []


@pytest.mark.parametrize(
    "source",
    [
        "import pickle",
        "from cloudpickle import loads",
        "np.load(f, allow_pickle=True)",
        "th.load(f, weights_only=True)",
    ],
)
def test_the_pickle_check_itself(source: str) -> None:
    assert unpickling(ast.parse(source))


def test_the_thread_check_itself() -> None:
    assert thread_settings(ast.parse("def f():\n    th.set_num_threads(1)"))
    assert thread_settings(ast.parse("os.environ['OMP_NUM_THREADS'] = '1'"))


# -- documentation ----------------------------------------------------------------------------------------------------


def undocumented(body: list[ast.stmt], owner: str = "") -> Iterator[str]:
    """Public functions, classes and methods without a docstring (a property's setter shares its getter's)."""
    for node in body:
        if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef) or node.name.startswith("_"):
            continue
        decorators = [ast.unparse(decorator) for decorator in node.decorator_list]
        if f"{node.name}.setter" in decorators or "overload" in decorators:
            continue
        if not ast.get_docstring(node):
            yield f"line {node.lineno}: {owner}{node.name}"
        if isinstance(node, ast.ClassDef):
            yield from undocumented(node.body, f"{node.name}.")


@pytest.mark.parametrize("path", FILES, ids=NAMES)
def test_everything_public_has_a_docstring(path: Path) -> None:
    tree = parse(path)
    assert list(undocumented(tree.body)) == []
    assert ast.get_docstring(tree) or not tree.body
