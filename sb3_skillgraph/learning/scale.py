"""Whether the event radius fits what the agent moves: looked at once, early, and told."""

import warnings

import numpy as np

from sb3_skillgraph.memory.store import TransitionStore
from sb3_skillgraph.metric import Metric

#: Environment steps, of all environments, after which it is told.
LOOK_AT = 3_000
#: A step of so many radii, in the median, goes past events without being seen in them.
LONG_STEP = 2.0


def tell_scale(store: TransitionStore, metric: Metric) -> None:
    """Warn where the radius does not fit, with numbers.

    :param store: the transitions so far
    :param metric: of goal space
    """
    rows = np.arange(store.oldest, store.total)
    before, after = store.column("achieved_goal", rows), store.column("next_achieved_goal", rows)
    step = float(np.median(metric.travel(after, before)))
    # How far every episode came from its begin; one that still runs counts only where none is over
    episodes, begins, episode = np.unique(store.trajectory(rows), return_index=True, return_inverse=True)
    extents = np.zeros(len(episodes))
    np.maximum.at(extents, episode, metric.travel(after, before[begins][episode]))
    over = ~store.is_running(episodes)
    extents = extents[over] if over.any() else extents
    extent = float(np.median(extents))
    if step > LONG_STEP:
        warnings.warn(
            f"A step is {step:.1f} event radii long in the median: the agent passes events without stopping in them. "
            f"event_radius={metric!r} is small for it; the environment's steps may be too long.",
            stacklevel=2,
        )
    if extent < 1.0:
        warnings.warn(
            f"In {len(extents)} episodes the achieved goal came {extent:.2g} event radii from its begin in the median "
            f"({extents.max():.2g} at most): it hardly moves, so that nearly all that the agent does happens in one event "
            "and there is no graph to plan on. If the goal is where an object is, only the walker learns, as SB3's HER "
            "does, until it moves the object; longer episodes, held actions (HoldAction) or a goal with the gripper in it "
            f"help. If not, event_radius={metric!r} is large for this environment.",
            stacklevel=2,
        )
