"""The random generators of the process, from which SB3's noise and networks draw."""

import random
from typing import Any

import numpy as np
import torch as th


def get_states() -> dict[str, Any]:
    """Return the states of Python's, NumPy's and torch's generator."""
    return {
        "python": list(random.getstate()),
        "numpy": np.random.get_state(legacy=False),  # noqa: NPY002
        "torch": th.get_rng_state(),
    }


def set_states(states: dict[str, Any]) -> None:
    """Set them to what :func:`get_states` returned."""
    random.setstate(tuple(states["python"]))
    np.random.set_state(states["numpy"])  # noqa: NPY002
    th.set_rng_state(states["torch"])
