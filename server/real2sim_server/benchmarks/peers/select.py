"""Which peers there are, and which can run here."""

from __future__ import annotations

import importlib.util

from .block import PeerBlock, PeerRun

PEERS = ("taichi", "warp")


def missing_reason(peer: str) -> str:
    """Why a peer cannot run here, or nothing."""
    if importlib.util.find_spec(peer) is None:
        return f"{peer} is not installed"
    return ""


def start_peer(peer: str, block: PeerBlock) -> PeerRun:
    """Load a block into the peer of that name; only here is it imported."""
    if peer == "taichi":
        from .taichi_peer import start
    else:
        from .warp_peer import start
    return start(block)
