"""The documentation site: ``make docs``."""

from sb3_skillgraph.version import __version__

project = "sb3_skillgraph"
author = "The sb3_skillgraph contributors"
version = release = __version__
html_title = f"sb3_skillgraph {release}"

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.doctest",
    "sphinx.ext.mathjax",
    "sphinx.ext.viewcode",
]
exclude_patterns = ["_build", "package.md"]  # what the package index shows
html_theme = "furo"
html_theme_options = {"navigation_with_keys": True}
myst_enable_extensions = ["colon_fence", "deflist"]
myst_heading_anchors = 3
autodoc_member_order = "bysource"
autodoc_typehints = "none"  # docstrings give types where they are not plain, with shapes and units
doctest_global_setup = """
import warnings
warnings.simplefilter("ignore")
import gymnasium as gym
import numpy as np
import torch as th
th.set_num_threads(1)
from sb3_skillgraph import *
from sb3_skillgraph.evaluation import *
from sb3_skillgraph.events import Event
from sb3_skillgraph.graph import SkillGraph
from sb3_skillgraph.metric import *
"""
