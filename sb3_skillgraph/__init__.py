"""Deep Skill Graphs for Stable-Baselines3."""

import sb3_skillgraph.envs  # registers the environments
from sb3_skillgraph.agent import PAPER, SkillGraphAgent
from sb3_skillgraph.options.env import OptionEnv
from sb3_skillgraph.version import __version__

__all__ = ["PAPER", "OptionEnv", "SkillGraphAgent", "__version__"]
