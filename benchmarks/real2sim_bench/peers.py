"""The same physics in other frameworks: what a peer gets and returns, and which are installed."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

CELLS = 40
"""Nodes along an edge of the peers' dense grid; it reaches from the origin to CELLS dx."""

Single = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class PeerBlock:
    """Fixed corotated particles on a dense grid, single precision, sorted by cell.

    Attributes:
        positions, velocities: [N, 3] [m], [m/s]; all stay inside the grid.
        mass, volume: of one particle [kg], [m^3].
        mu, lam: Lame's constants [Pa].
        dx, dt: cell [m] and substep [s].
        gravity: along z [m/s^2].
        threads: to use.
    """

    positions: Single
    velocities: Single
    mass: float
    volume: float
    mu: float
    lam: float
    dx: float
    dt: float
    gravity: float
    threads: int


@dataclass(frozen=True, eq=False)
class PeerRun:
    """A block in motion elsewhere.

    Attributes:
        advance: makes that many substeps and waits for them.
        positions: gives [N, 3] in the order of the block [m].
    """

    advance: Callable[[int], None]
    positions: Callable[[], Single]


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
