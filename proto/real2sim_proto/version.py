"""Versions of the contract, and what happens when two sides do not speak the same one."""

from __future__ import annotations

PROTOCOL_VERSION = 1
"""Major version of REST paths (``/v1``) and of the drive socket (field ``v`` of every message)."""

DRIVE_SUBPROTOCOL = "real2sim.v1.msgpack"
"""WebSocket subprotocol of the drive socket."""

SUPPORTED_SUBPROTOCOLS = (DRIVE_SUBPROTOCOL,)


def protocol_mismatch(offered: list[str]) -> str:
    """Sentence that names both sides' versions and what to do.

    Examples:
        >>> protocol_mismatch(["real2sim.v9.msgpack"]).partition(";")[0]
        'the client offers drive protocol real2sim.v9.msgpack'
    """
    given = ", ".join(offered) if offered else "none"
    spoken = ", ".join(SUPPORTED_SUBPROTOCOLS)
    return (
        f"the client offers drive protocol {given}; this worker speaks {spoken}. "
        "Install a client and a worker of the same major version."
    )
