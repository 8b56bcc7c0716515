"""When a request is sent again, and after how long."""

from __future__ import annotations

import math
import random
import time
from collections.abc import Callable
from dataclasses import dataclass
from email.utils import parsedate_to_datetime

from real2sim_proto import RETRYABLE

RETRYABLE_STATUS = frozenset({408, 429, 502, 503, 504})

RETRYABLE_CODES = frozenset(code.value for code in RETRYABLE)
"""Codes of this package's protocol that pass, whatever their status."""


@dataclass(frozen=True)
class RetryPolicy:
    """Exponential back-off with jitter; the worker's ``Retry-After`` comes first.

    Attributes:
        retries: tries after the first one; 0 turns retrying off.
        first_delay: seconds before the first retry; doubles with each.
        longest_delay: seconds; cap of the own back-off.
        longest_wait_asked: seconds; a worker that asks for more is not waited for.
    """

    retries: int = 2
    first_delay: float = 0.5
    longest_delay: float = 8.0
    longest_wait_asked: float = 120.0

    def __post_init__(self) -> None:
        if self.retries < 0:
            raise ValueError(f"retries is {self.retries!r}; give 0 or more")

    def delay(
        self,
        attempt: int,
        *,
        retry_after: float | None = None,
        jitter: Callable[[], float] = random.random,
    ) -> float | None:
        """Seconds to wait after failed try number ``attempt`` (0 is the first); None to give up."""
        if attempt >= self.retries:
            return None
        if retry_after is not None:
            return retry_after if retry_after <= self.longest_wait_asked else None
        backoff = min(self.first_delay * 2.0**attempt, self.longest_delay)
        return backoff * (1.0 - 0.25 * jitter())


def parse_retry_after(value: str | None, *, now: float | None = None) -> float | None:
    """Seconds of a ``Retry-After`` header: a number or an HTTP date; None where there is none."""
    if value is None:
        return None
    try:
        seconds = float(value)
    except ValueError:
        try:
            moment = parsedate_to_datetime(value).timestamp()
        except ValueError:
            return None
        seconds = moment - (time.time() if now is None else now)
    return None if math.isnan(seconds) else max(seconds, 0.0)
