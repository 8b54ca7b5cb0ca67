"""How the memory's kernels are compiled."""

from __future__ import annotations

from functools import partial

from numba import njit

# Division by zero gives infinity, as in numpy; numba's default raises, and the branch that it
# needs for that keeps loops from being vectorised (measured: ten times slower projection).
compiled = partial(njit, cache=True, error_model="numpy")

# Relaxed rounding that still honours NaN and infinity.
FAST = {"nsz", "arcp", "contract", "reassoc"}
