"""What compiled kernels take of a GPU, as ptxas says it."""

from __future__ import annotations

import re
from dataclasses import dataclass

from .records import THREADS

_PATTERN = re.compile(
    r"entry function '(?P<kernel>\w+)'.*?(?P<stack>\d+) bytes stack frame, "
    r"(?P<stores>\d+) bytes spill stores, (?P<loads>\d+) bytes spill loads.*?"
    r"Used (?P<registers>\d+) registers(?:[^\n]*?(?P<shared>\d+) bytes smem)?",
    re.DOTALL,
)
REGISTERS = 65_536
"""Of a multiprocessor, handed out to warps in steps of REGISTER_STEP."""
REGISTER_STEP = 256
BLOCK_SHARED = 1024
"""Shared memory that every block takes besides its own [bytes]."""
MULTIPROCESSORS = {
    "sm_75": (1024, 64 << 10),
    "sm_80": (2048, 164 << 10),
    "sm_86": (1536, 100 << 10),
    "sm_89": (1536, 100 << 10),
    "sm_90": (2048, 228 << 10),
    "sm_100": (2048, 228 << 10),
    "sm_120": (1536, 100 << 10),
}
"""Threads and shared memory [bytes] of one, from the CUDA programming guide."""


@dataclass(frozen=True)
class Usage:
    """What a compiled kernel takes.

    Attributes:
        registers: of each thread.
        shared: memory of each block [bytes].
        stack: of each thread [bytes].
        spilled: what registers did not hold, written and read [bytes].
    """

    registers: int
    shared: int
    stack: int
    spilled: int

    def occupancy(self, architecture: str, of_block: int = THREADS) -> float:
        """Share of a multiprocessor's threads that can be at work at once, in blocks of so many.

        Raises:
            KeyError: for an architecture that MULTIPROCESSORS does not know.
        """
        threads, shared = MULTIPROCESSORS[architecture]
        of_warp = -(-self.registers * 32 // REGISTER_STEP) * REGISTER_STEP
        blocks = min(
            threads // of_block,
            REGISTERS // of_warp // (of_block // 32),
            shared // (self.shared + BLOCK_SHARED),
        )
        return blocks * of_block / threads


def usage_of(log: str) -> dict[str, Usage]:
    """What each kernel takes, from the words of ptxas."""
    return {
        found["kernel"]: Usage(
            registers=int(found["registers"]),
            shared=int(found["shared"] or 0),
            stack=int(found["stack"]),
            spilled=int(found["stores"]) + int(found["loads"]),
        )
        for found in _PATTERN.finditer(log)
    }
