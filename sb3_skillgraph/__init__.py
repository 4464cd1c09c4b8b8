"""Deep Skill Graphs for Stable-Baselines3."""

from sb3_skillgraph import envs  # registers the environments
from sb3_skillgraph.agent import SkillGraphAgent
from sb3_skillgraph.evaluation import evaluate_pairs
from sb3_skillgraph.options.env import OptionEnv
from sb3_skillgraph.rules import PAPER, PaperRules
from sb3_skillgraph.smdp import OptionsEnv, SMDPQLearning
from sb3_skillgraph.version import __version__

__all__ = [
    "PAPER",
    "OptionEnv",
    "OptionsEnv",
    "PaperRules",
    "SMDPQLearning",
    "SkillGraphAgent",
    "__version__",
    "envs",
    "evaluate_pairs",
]
