"""Random numbers by name: each depends on the seed and on what it is for, on nothing else.

The words come from NumPy's ``SeedSequence``, a hash of seed and key whose values are guaranteed not
to change; what is made of them here is arithmetic. So nothing depends on the order of draws, on
the number of threads, or on which of them were needed before.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Draws:
    """What the seed of an episode draws.

    Attributes:
        seed: of the episode.
    """

    seed: int

    def uniform(self, what: str, *counters: int, count: int = 1) -> list[float]:
        """``count`` numbers, uniform in [0, 1), for ``what`` and non-negative ``counters``."""
        key = (*_words(what), *counters)
        words = np.random.SeedSequence(self.seed, spawn_key=key).generate_state(count, np.uint64)
        return [(word >> 11) * 2.0**-53 for word in words.tolist()]

    def around(self, width: float, what: str, *counters: int) -> float:
        """Uniform in [-width, width); 0 without a draw where the width is 0."""
        return (2.0 * self.uniform(what, *counters)[0] - 1.0) * width if width else 0.0

    def normal(self, what: str, *counters: int, count: int = 1) -> list[float]:
        """``count`` numbers of the standard normal distribution (Box & Muller 1958)."""
        pairs = (count + 1) // 2
        numbers = self.uniform(what, *counters, count=2 * pairs)
        found: list[float] = []
        for u, v in zip(numbers[::2], numbers[1::2], strict=True):
            radius, angle = math.sqrt(-2.0 * math.log(1.0 - u)), math.tau * v
            found += [radius * math.cos(angle), radius * math.sin(angle)]
        return found[:count]


def _words(what: str) -> tuple[int, int]:
    digest = hashlib.blake2b(what.encode(), digest_size=8).digest()
    return int.from_bytes(digest[:4], "little"), int.from_bytes(digest[4:], "little")
