"""How kernels are compiled."""

from __future__ import annotations

from functools import partial

from numba import njit, threading_layer

# Division by zero gives infinity, as in numpy; numba's default raises, and the branch that it
# needs for that keeps loops from being vectorised (measured: ten times slower projection).
# Other threads go on meanwhile: those that read and write files, and other memories' kernels.
compiled = partial(njit, cache=True, error_model="numpy", nogil=True)

# Relaxed rounding that still honours NaN and infinity.
FAST = {"nsz", "arcp", "contract", "reassoc"}


def run_beside_each_other() -> bool:
    """Whether kernels that use several threads may run in two threads at once.

    With numba's own pool, the last resort where neither OpenMP nor TBB is, they must not.
    """
    try:
        return str(threading_layer()) in ("omp", "tbb")
    except ValueError:  # no such kernel has run yet
        return False
