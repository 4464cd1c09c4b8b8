"""BLAS's product of matrices, for compiled code to call: torch's own, where it can be found."""

import ctypes

import llvmlite.binding
import torch as th
from numba.extending import get_cython_function_address


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


SGEMM = "sb3_skillgraph_sgemm"  # by which compiled code on disk finds it again
llvmlite.binding.add_symbol(SGEMM, find_sgemm())
