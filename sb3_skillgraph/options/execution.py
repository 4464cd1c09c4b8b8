"""Running an option for one step: when it ends, and how (section 2.1, A.6). Pure functions, used wherever options run."""

from enum import IntEnum


class Fate(IntEnum):
    """What has become of a running option."""

    RUNNING = 0
    SUCCEEDED = 1
    TIMED_OUT = 2
    STUCK = 3


def fate(reached: bool, steps: int, timeout: int, stuck: bool = False) -> Fate:
    """Tell whether a running option goes on.

    :param reached: whether the agent stands in the option's termination set
    :param steps: environment steps the option has run
    :param timeout: environment steps it may run
    :param stuck: whether the agent can do nothing any more, as its environment tells in ``info["stuck"]``
    :return: getting stuck takes precedence over success on the same step, success over a timeout
    """
    if stuck:
        return Fate.STUCK
    if reached:
        return Fate.SUCCEEDED
    return Fate.TIMED_OUT if steps >= timeout else Fate.RUNNING
