"""Networks that more than one part of the library uses, and the number types that they take."""

from __future__ import annotations

from typing import Literal

# Here and not in compute.py, which imports torch: settings name them.
Precision = Literal["auto", "float32", "bfloat16", "float16"]
TrainingPrecision = Literal["auto", "float32", "bfloat16"]
