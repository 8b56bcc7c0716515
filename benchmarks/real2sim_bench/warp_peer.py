"""MLS-MPM in Warp, parallelised on its CPU device.

A CPU launch uses one thread but releases the GIL. Particles are divided into slabs along x; a
thread pool launches even slabs, then odd slabs. Slabs are wider than the stencil, so no two slabs
of one colour write to the same node.
"""

from __future__ import annotations

import itertools
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import warp as wp

from .peers import CELLS, PeerBlock, PeerRun

# Warp evaluates annotations, so they must not become strings; mypy cannot read them as types.
# ruff: noqa: PLR0917
# mypy: ignore-errors


SLAB = 4
"""Width of a slab [cells]; particles may leave it by one cell before slabs of one colour meet."""
POLAR_STEPS = wp.constant(4)
SIDE = wp.constant(CELLS)


@wp.struct
class WarpParameters:
    """Constants of a run."""

    mass: wp.float32
    volume: wp.float32
    mu: wp.float32
    lam: wp.float32
    dx: wp.float32
    dt: wp.float32
    gravity: wp.float32


@wp.func
def polar_rotation(F: wp.mat33):
    """Rotation of the polar decomposition, by Newton iteration."""
    R = F
    for _ in range(POLAR_STEPS):
        R = 0.5 * (R + wp.transpose(wp.inverse(R)))
    return R


@wp.kernel
def scatter(
    first: int,
    x: wp.array(dtype=wp.vec3),
    v: wp.array(dtype=wp.vec3),
    C: wp.array(dtype=wp.mat33),
    F: wp.array(dtype=wp.mat33),
    grid: wp.array(dtype=wp.vec4),
    params: WarpParameters,
):
    """Update deformation and transfer momentum from particles to the grid."""
    p = first + wp.tid()
    at = x[p] / params.dx
    bx = int(at[0] - 0.5)
    by = int(at[1] - 0.5)
    bz = int(at[2] - 0.5)
    f = at - wp.vec3(float(bx), float(by), float(bz))
    a = wp.vec3(1.5, 1.5, 1.5) - f
    m = f - wp.vec3(1.0, 1.0, 1.0)
    b = f - wp.vec3(0.5, 0.5, 0.5)
    w = wp.matrix_from_rows(
        0.5 * wp.cw_mul(a, a), wp.vec3(0.75, 0.75, 0.75) - wp.cw_mul(m, m), 0.5 * wp.cw_mul(b, b)
    )
    eye = wp.identity(n=3, dtype=wp.float32)
    deformed = (eye + params.dt * C[p]) * F[p]
    F[p] = deformed
    J = wp.determinant(deformed)
    R = polar_rotation(deformed)
    tau = 2.0 * params.mu * (deformed - R) * wp.transpose(deformed)
    tau = tau + eye * (params.lam * J * (J - 1.0))
    Q = (-params.dt * params.volume * 4.0 / (params.dx * params.dx)) * tau + params.mass * C[p]
    start = params.mass * v[p] - Q * (f * params.dx)
    qx = Q * wp.vec3(params.dx, 0.0, 0.0)
    qy = Q * wp.vec3(0.0, params.dx, 0.0)
    qz = Q * wp.vec3(0.0, 0.0, params.dx)
    for i in range(3):
        for j in range(3):
            row = start + float(i) * qx + float(j) * qy
            wij = w[i, 0] * w[j, 1]
            node = ((bx + i) * SIDE + by + j) * SIDE + bz
            for k in range(3):
                weight = wij * w[k, 2]
                g = weight * (row + float(k) * qz)
                wp.atomic_add(grid, node + k, wp.vec4(g[0], g[1], g[2], weight * params.mass))


@wp.kernel
def move_grid(first: int, grid: wp.array(dtype=wp.vec4), params: WarpParameters):
    """Compute grid velocities from momentum, and add gravity."""
    node = first + wp.tid()
    g = grid[node]
    if g[3] > 0.0:
        inverse = 1.0 / g[3]
        grid[node] = wp.vec4(
            g[0] * inverse, g[1] * inverse, g[2] * inverse + params.dt * params.gravity, g[3]
        )


@wp.kernel
def gather(
    first: int,
    x: wp.array(dtype=wp.vec3),
    v: wp.array(dtype=wp.vec3),
    C: wp.array(dtype=wp.mat33),
    grid: wp.array(dtype=wp.vec4),
    params: WarpParameters,
):
    """Transfer grid velocities to the particles."""
    p = first + wp.tid()
    at = x[p] / params.dx
    bx = int(at[0] - 0.5)
    by = int(at[1] - 0.5)
    bz = int(at[2] - 0.5)
    f = at - wp.vec3(float(bx), float(by), float(bz))
    a = wp.vec3(1.5, 1.5, 1.5) - f
    m = f - wp.vec3(1.0, 1.0, 1.0)
    b = f - wp.vec3(0.5, 0.5, 0.5)
    w = wp.matrix_from_rows(
        0.5 * wp.cw_mul(a, a), wp.vec3(0.75, 0.75, 0.75) - wp.cw_mul(m, m), 0.5 * wp.cw_mul(b, b)
    )
    velocity = wp.vec3(0.0, 0.0, 0.0)
    gradient = wp.mat33(0.0)
    for i in range(3):
        for j in range(3):
            wij = w[i, 0] * w[j, 1]
            node = ((bx + i) * SIDE + by + j) * SIDE + bz
            for k in range(3):
                g = grid[node + k]
                seen = (wij * w[k, 2]) * wp.vec3(g[0], g[1], g[2])
                velocity += seen
                gradient += wp.outer(seen, wp.vec3(float(i), float(j), float(k)) - f)
    v[p] = velocity
    C[p] = (4.0 / params.dx) * gradient
    x[p] = x[p] + params.dt * velocity


def start(block: PeerBlock) -> PeerRun:
    """Load a block on the CPU."""
    wp.config.quiet = True
    wp.config.enable_backward = False
    wp.init()
    solver = WarpSolver(block)
    return PeerRun(solver.advance, solver.positions)


class WarpSolver:
    """Arrays and launches of one block."""

    def __init__(self, block: PeerBlock) -> None:
        slab = ((block.positions[:, 0] / block.dx - 0.5).astype(int)) // SLAB
        self.order = np.argsort(slab, kind="stable")
        cuts = np.searchsorted(slab[self.order], np.arange(slab.max() + 2))
        self.slabs = [(int(a), int(b - a)) for a, b in itertools.pairwise(cuts)]
        n = len(slab)
        eye = np.tile(np.eye(3, dtype=np.float32), (n, 1, 1))
        self.x = wp.array(block.positions[self.order], dtype=wp.vec3, device="cpu")
        self.v = wp.array(block.velocities[self.order], dtype=wp.vec3, device="cpu")
        self.C = wp.zeros(n, dtype=wp.mat33, device="cpu")
        self.F = wp.array(eye, dtype=wp.mat33, device="cpu")
        self.grid = wp.zeros(CELLS**3, dtype=wp.vec4, device="cpu")
        self.params = WarpParameters()
        for name in ("mass", "volume", "mu", "lam", "dx", "dt", "gravity"):
            setattr(self.params, name, getattr(block, name))
        self.threads = block.threads
        self.pool = ThreadPoolExecutor(block.threads)
        wp.load_module(device="cpu")

    def advance(self, steps: int) -> None:
        """Run substeps."""
        particles = [self.x, self.v, self.C]
        for _ in range(steps):
            self.grid.zero_()
            for colour in (0, 1):
                inputs = [*particles, self.F, self.grid, self.params]
                self._launch(scatter, self.slabs[colour::2], inputs)
            self._launch(move_grid, self._slices(len(self.grid)), [self.grid, self.params])
            slices = self._slices(len(self.x))
            self._launch(gather, slices, [*particles, self.grid, self.params])

    def positions(self) -> Any:
        """Positions [N, 3] in the order of the block [m]."""
        out = np.empty((len(self.order), 3), np.float32)
        out[self.order] = self.x.numpy()
        return out

    def _slices(self, count: int) -> list[tuple[int, int]]:
        cuts = np.linspace(0, count, self.threads + 1).astype(int)
        return [(int(a), int(b - a)) for a, b in itertools.pairwise(cuts)]

    def _launch(self, kernel: Any, parts: list[tuple[int, int]], inputs: list[Any]) -> None:
        waits = [
            self.pool.submit(wp.launch, kernel, dim=count, inputs=[first, *inputs], device="cpu")
            for first, count in parts
            if count
        ]
        for wait in waits:
            wait.result()
