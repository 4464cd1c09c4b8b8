"""The product of matrices, for compiled code: by torch's own BLAS, where it can be found."""

import ctypes
from typing import Any

import llvmlite.binding
import numpy as np
import torch as th
from numba import types
from numba.extending import get_cython_function_address

from sb3_skillgraph.options.compiling import inner


def find_sgemm() -> int:
    """
    :return: address of BLAS's product of matrices: torch's (at these sizes Intel's, which it has on x86, takes two thirds of
        the time), else SciPy's
    """
    try:
        address = ctypes.cast(ctypes.CDLL(th._C.__file__).sgemm_, ctypes.c_void_p).value
    except (AttributeError, OSError):
        address = None
    return address or get_cython_function_address("scipy.linalg.cython_blas", "sgemm")


_TEXT, _WHOLE, _FLOAT = (types.CPointer(kind) for kind in (types.uint8, types.int64, types.float32))
_NAME = "sb3_skillgraph_sgemm"  # by which compiled code on disk finds it again
llvmlite.binding.add_symbol(_NAME, find_sgemm())
# Whether to transpose; sizes; a factor; matrices with the lengths of their rows; another factor; the result, likewise
_sgemm: Any = types.ExternalFunction(
    _NAME,
    types.void(_TEXT, _TEXT, _WHOLE, _WHOLE, _WHOLE, _FLOAT, _FLOAT, _WHOLE, _FLOAT, _WHOLE, _FLOAT, _FLOAT, _WHOLE),
)

#: Columns of a result up to which turning it pays: BLAS takes its columns for rows, and is slow where they are so short.
NARROW = 12


@inner
def multiply(left: np.ndarray, right: np.ndarray, left_turned: bool, right_turned: bool) -> np.ndarray:
    """
    :param left: (m, k), or (k, m) if it is to be transposed
    :param right: (k, n), or (n, k) if it is to be transposed
    :param left_turned: whether it is
    :param right_turned: whether it is
    :return: (m, n)
    """
    m, k = (left.shape[1], left.shape[0]) if left_turned else left.shape
    n = right.shape[0] if right_turned else right.shape[1]
    result = np.empty((m, n), np.float32)
    # BLAS goes by columns, and sees every matrix transposed: the right one comes first. Whole numbers of 64 bits are read
    # right by one that expects 32, too, where the low ones come first.
    turn = np.array([ord("T") if right_turned else ord("N"), ord("T") if left_turned else ord("N")], np.uint8)
    sizes = np.array([n, m, k, right.shape[1], left.shape[1]], np.int64)
    factors = np.array([1.0, 0.0], np.float32)
    _sgemm(
        turn.ctypes,
        turn[1:].ctypes,
        sizes.ctypes,
        sizes[1:].ctypes,
        sizes[2:].ctypes,
        factors.ctypes,
        right.ctypes,
        sizes[3:].ctypes,
        left.ctypes,
        sizes[4:].ctypes,
        factors[1:].ctypes,
        result.ctypes,
        sizes.ctypes,
    )
    return result


@inner
def product(left: np.ndarray, right: np.ndarray, left_turned: bool, right_turned: bool) -> np.ndarray:
    """
    :param left: (m, k), or (k, m) if it is to be transposed
    :param right: (k, n), or (n, k) if it is to be transposed
    :param left_turned: whether it is
    :param right_turned: whether it is
    :return: (m, n)
    """
    m = left.shape[1] if left_turned else left.shape[0]
    n = right.shape[0] if right_turned else right.shape[1]
    if not 1 < n <= NARROW < m:
        return multiply(left, right, left_turned, right_turned)
    # The same the other way round, from an eighth to a half of the time
    turned = multiply(right, left, not right_turned, not left_turned)
    result = np.empty((m, n), np.float32)
    for i in range(m):
        for j in range(n):
            result[i, j] = turned[j, i]
    return result
