"""Having numba compile functions."""

from collections.abc import Callable
from typing import Any

from numba import njit


def compiled(function: Callable[..., Any], **options: Any) -> Callable[..., Any]:
    """
    Have numba compile a function when it is first called, and keep the result on disk where it finds a place for it.

    :param function: one that numba understands
    :param options: further ones of numba's
    :return: the same in machine code
    """
    # NumPy's division does not check for zeros, which lets loops be vectorised.
    options = {"error_model": "numpy", "no_cfunc_wrapper": True, **options}
    try:
        return njit(function, cache=True, **options)
    except RuntimeError:
        return njit(function, **options)


def inner(function: Callable[..., Any], **options: Any) -> Callable[..., Any]:
    """
    Compile a function that only compiled ones call: without what Python would call it by, that is a fifth sooner.

    :param function: one that numba understands
    :param options: further ones of numba's
    :return: the same in machine code
    """
    return compiled(function, no_cpython_wrapper=True, **options)


def inlined(function: Callable[..., Any]) -> Callable[..., Any]:
    """
    Compile an inner function that is called in one place as a part of what calls it: a large one is not optimised twice then.

    :param function: one that numba understands
    :return: the same for compiled functions to call
    """
    return inner(function, inline="always")
