"""Which request made a bundle. Files and answers cannot be stored together, so a bundle appears
with the claim of its request, and loses it once the answer is stored.

A request that is sent again after a crash in between knows its own bundle by that, and gets its
answer; any other finds the name taken.
"""

from __future__ import annotations

import contextlib
from pathlib import Path

CLAIM_FILE = ".made_by"


def put_claim(bundle: Path, claim: str | None) -> None:
    """Mark a bundle that nobody sees yet; ``claim`` is None for requests without a key."""
    if claim is not None:
        (bundle / CLAIM_FILE).write_text(claim, encoding="utf-8")


def bears_claim(bundle: Path, claim: str | None) -> bool:
    """Whether the bundle is there and was made by that request, whose answer was not stored."""
    try:
        return claim is not None and (bundle / CLAIM_FILE).read_text(encoding="utf-8") == claim
    except (OSError, ValueError):
        return False


def drop_claim(bundle: Path) -> None:
    """Forget who made a bundle. Where that cannot be done the claim does no harm."""
    with contextlib.suppress(OSError):
        (bundle / CLAIM_FILE).unlink(missing_ok=True)
