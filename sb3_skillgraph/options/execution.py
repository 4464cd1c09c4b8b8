"""Running an option for one step: when it ends, and how (section 2.1, A.6). Pure functions, used wherever options run."""

from enum import IntEnum

import numpy as np

from sb3_skillgraph.events import TerminationSet


class Fate(IntEnum):
    """What has become of a running option."""

    RUNNING = 0
    SUCCEEDED = 1
    TIMED_OUT = 2


def fate(termination: TerminationSet, point: np.ndarray, steps: int, timeout: int) -> Fate:
    """Tell whether a running option goes on.

    :param termination: the set it ends in
    :param point: where the agent stands, shape ``(goal_dim,)``
    :param steps: environment steps the option has run
    :param timeout: environment steps it may run
    :return: success takes precedence over a timeout on the same step
    """
    if termination.contains(point[None])[0]:
        return Fate.SUCCEEDED
    return Fate.TIMED_OUT if steps >= timeout else Fate.RUNNING
