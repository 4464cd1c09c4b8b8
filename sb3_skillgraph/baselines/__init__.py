"""What an agent has to beat."""

from sb3_skillgraph.baselines.random_walk import RandomWalk

__all__ = ["RandomWalk"]
