"""Deep Skill Graphs for Stable-Baselines3."""

from sb3_skillgraph import envs  # registers the environments
from sb3_skillgraph.agent import SkillGraphAgent
from sb3_skillgraph.version import __version__

__all__ = [
    "SkillGraphAgent",
    "__version__",
    "envs",
]
