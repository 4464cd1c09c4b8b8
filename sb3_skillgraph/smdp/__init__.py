"""The SMDP above the options: an environment whose actions are options, and what chooses among them (section 2.1)."""

from sb3_skillgraph.smdp.flat_policy import FlatPolicy
from sb3_skillgraph.smdp.graph_policy import GraphPolicy
from sb3_skillgraph.smdp.options_env import OptionsEnv
from sb3_skillgraph.smdp.q_learning import SMDPQLearning

__all__ = ["FlatPolicy", "GraphPolicy", "OptionsEnv", "SMDPQLearning"]
