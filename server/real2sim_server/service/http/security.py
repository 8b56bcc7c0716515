"""What browsers are told about every answer: not to guess, not to embed, not to run."""

from __future__ import annotations

from starlette.datastructures import MutableHeaders

NOTHING = "default-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
"""Content security policy of answers that are no pages."""

SECURITY_HEADERS = {
    "Content-Security-Policy": NOTHING,
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}


def secure(headers: MutableHeaders) -> None:
    """Add what is missing; a page brings a policy of its own."""
    for name, value in SECURITY_HEADERS.items():
        headers.setdefault(name, value)
