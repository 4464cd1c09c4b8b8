"""The pages that say what the algorithm does name functions that exist."""

import doctest
import importlib
import pkgutil
import re
from pathlib import Path

import gymnasium as gym
import numpy as np
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


@pytest.mark.parametrize("module", ["agent", "evaluation", "graph", "metric", "options.env", "smdp.options_env"])
def test_the_examples_in_docstrings_hold(module: str) -> None:
    names = {"gym": gym, "np": np, **{name: getattr(sb3_skillgraph, name) for name in sb3_skillgraph.__all__}}
    tested = importlib.import_module(f"sb3_skillgraph.{module}")
    result = doctest.testmod(tested, extraglobs=names, optionflags=doctest.NORMALIZE_WHITESPACE)
    assert result.attempted > 0 and result.failed == 0


def test_what_a_package_index_shows_has_no_links_that_die_there() -> None:
    text = (DOCS / "package.md").read_text()
    assert not re.findall(r"\]\((?!https?://)[^)]*\)", text)
    assert "long_description = file: docs/package.md" in (DOCS.parent / "setup.cfg").read_text()
