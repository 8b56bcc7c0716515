"""The same physics in other frameworks: a common interface, and availability."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

CELLS = 40
"""Nodes along an edge of the peers' dense grid, which extends from the origin to CELLS dx."""

Single = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class PeerBlock:
    """Fixed corotated particles on a dense grid, single precision, sorted by cell.

    Attributes:
        positions, velocities: [N, 3] [m], [m/s]; particles stay inside the grid.
        mass, volume: mass [kg] and volume [m^3] of a particle.
        mu, lam: Lame parameters [Pa].
        dx, dt: cell size [m] and substep [s].
        gravity: acceleration along z [m/s^2].
        threads: number of threads.
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
    """A simulation of a block in another framework.

    Attributes:
        advance: runs a number of substeps and waits for them.
        positions: returns positions [N, 3] in the order of the block [m].
    """

    advance: Callable[[int], None]
    positions: Callable[[], Single]


PEERS = ("taichi", "warp")


def missing_reason(peer: str) -> str:
    """Reason why a peer cannot run here; empty if it can."""
    if importlib.util.find_spec(peer) is None:
        return f"{peer} is not installed"
    return ""


def start_peer(peer: str, block: PeerBlock) -> PeerRun:
    """Load a block into a peer, which is imported on demand."""
    if peer == "taichi":
        from .taichi_peer import start
    else:
        from .warp_peer import start
    return start(block)
