"""The page that says what the algorithm does names functions that exist."""

import importlib
import pkgutil
import re
from pathlib import Path

import pytest

import sb3_skillgraph

PAGE = Path(__file__).parents[1] / "docs" / "algorithm.md"
NAMED = sorted(set(re.findall(r"\b([A-Z]\w+)\.(_?[a-z]\w*)", PAGE.read_text())))


def classes() -> dict[str, type]:
    modules = [
        importlib.import_module(info.name) for info in pkgutil.walk_packages(sb3_skillgraph.__path__, "sb3_skillgraph.")
    ]
    return {name: item for module in modules for name, item in vars(module).items() if isinstance(item, type)}


def test_the_page_names_many_functions() -> None:
    assert len(NAMED) > 30


@pytest.mark.parametrize(("owner", "name"), NAMED)
def test_a_named_function_exists(owner: str, name: str) -> None:
    assert hasattr(classes()[owner], name)
