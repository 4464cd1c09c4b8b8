"""The pages that say what the algorithm does name functions that exist."""

import importlib
import pkgutil
import re
from pathlib import Path

import pytest

import sb3_skillgraph

DOCS = Path(__file__).parents[1] / "docs"
PAGES = DOCS / "algorithm.md", DOCS / "paper.md"
NAMED = sorted({found for page in PAGES for found in re.findall(r"`?\b([A-Z]\w+)\.(_?[a-z]\w*)", page.read_text())})


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
