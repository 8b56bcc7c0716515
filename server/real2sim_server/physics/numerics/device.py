"""How functions for kernels are marked, and their constants."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba.extending import register_jitable

FASTMATH = {"contract", "nsz", "arcp"}
"""Fused multiply-add and reciprocals; NaN and infinity keep their meaning, and show."""

device_function: Any = register_jitable(fastmath=FASTMATH, error_model="numpy")
"""Decorator of functions that kernels of every backend may call; Python may call them, too."""

F32 = np.float32
ZERO, HALF, ONE, TWO, THREE, FOUR = (F32(v) for v in (0, 0.5, 1, 2, 3, 4))
THREE_QUARTERS, THREE_HALVES = F32(0.75), F32(1.5)
TINY = F32(1e-30)
