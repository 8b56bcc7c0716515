"""How functions for kernels are marked, and their constants."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped, unused-ignore]
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, overload, register_jitable

FASTMATH = {"contract", "nsz", "arcp"}
"""Fused multiply-add and reciprocals; NaN and infinity keep their meaning, and show."""

device_function: Any = register_jitable(fastmath=FASTMATH, error_model="numpy")
"""Decorator of functions that kernels of every backend may call; Python may call them, too."""

F32 = np.float32
ZERO, HALF, ONE, TWO, THREE, FOUR = (F32(v) for v in (0, 0.5, 1, 2, 3, 4))
THREE_QUARTERS, THREE_HALVES = F32(0.75), F32(1.5)
TINY = F32(1e-30)


def square_root(x: Any) -> Any:
    """Square root of a number that is not negative.

    In kernels an instruction of the processor, which loops over lanes become vector code with;
    ``math.sqrt`` calls the C library for the sake of negative numbers.
    """
    return math.sqrt(x)


@intrinsic
def _root(typingctx, x):
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kind = context.get_value_type(signature.args[0])
        name = f"llvm.sqrt.f{32 if kind == ir.FloatType() else 64}"
        function = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(kind, [kind]), name
        )
        return builder.call(function, arguments)

    return (x(x), generate) if isinstance(x, types.Float) else None


@overload(square_root)
def _square_root(x):
    def root(x):
        return _root(x)

    return root
