"""Running an option for one step: when it ends, and how (section 2.1, A.6). Pure functions, used wherever options run."""

from enum import IntEnum


class Fate(IntEnum):
    """What has become of a running option."""

    RUNNING = 0
    SUCCEEDED = 1
    TIMED_OUT = 2


def fate(reached: bool, steps: int, timeout: int) -> Fate:
    """Tell whether a running option goes on.

    :param reached: whether the agent stands in the option's termination set
    :param steps: environment steps the option has run
    :param timeout: environment steps it may run
    :return: success takes precedence over a timeout on the same step
    """
    if reached:
        return Fate.SUCCEEDED
    return Fate.TIMED_OUT if steps >= timeout else Fate.RUNNING
