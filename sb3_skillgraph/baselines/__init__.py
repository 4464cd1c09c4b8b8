"""What the agent is compared with (sections 4.1, 4.2.1, A.5)."""

from sb3_skillgraph.baselines.covering_options import CoveringOptions
from sb3_skillgraph.baselines.goal_conditioned import GoalSchedule, OptionTask, make_her, make_uvfa
from sb3_skillgraph.baselines.random_walk import RandomWalk, random_walk
from sb3_skillgraph.baselines.recipe import HindsightRecipe, NewGoals
from sb3_skillgraph.baselines.replay_search import ReplaySearch
from sb3_skillgraph.baselines.straight_on import StraightOn

__all__ = [
    "CoveringOptions",
    "GoalSchedule",
    "HindsightRecipe",
    "NewGoals",
    "OptionTask",
    "RandomWalk",
    "ReplaySearch",
    "StraightOn",
    "make_her",
    "make_uvfa",
    "random_walk",
]
