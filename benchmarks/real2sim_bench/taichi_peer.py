"""MLS-MPM in Taichi, after Taichi's mpm3d example, with a Newton polar decomposition."""

from __future__ import annotations

import taichi as ti

from .peers import CELLS, PeerBlock, PeerRun

# Taichi evaluates annotations, so they must not become strings.


POLAR_STEPS = 4


def start(block: PeerBlock) -> PeerRun:
    """Load a block on the CPU."""
    ti.init(arch=ti.cpu, log_level=ti.ERROR, cpu_max_num_threads=block.threads, fast_math=True)
    solver = TaichiSolver(block)
    return PeerRun(solver.advance, solver.x.to_numpy)


@ti.data_oriented
class TaichiSolver:
    """Fields and kernels of one block."""

    def __init__(self, block: PeerBlock) -> None:
        n = len(block.positions)
        self.x = ti.Vector.field(3, ti.f32, n)
        self.v = ti.Vector.field(3, ti.f32, n)
        self.C = ti.Matrix.field(3, 3, ti.f32, n)
        self.F = ti.Matrix.field(3, 3, ti.f32, n)
        # Momentum and mass in one vector, so that a node needs a single memory access.
        self.grid = ti.Vector.field(4, ti.f32, (CELLS, CELLS, CELLS))
        self.x.from_numpy(block.positions)
        self.v.from_numpy(block.velocities)
        # Numeric attributes of self become kernel constants.
        self.mass, self.volume, self.mu, self.lam = block.mass, block.volume, block.mu, block.lam
        self.dx, self.dt, self.gravity = block.dx, block.dt, block.gravity
        self.reset()

    def advance(self, steps: int) -> None:
        """Run substeps."""
        for _ in range(steps):
            self.grid.fill(0)
            self.scatter()
            self.gather()
        ti.sync()

    @ti.kernel
    def reset(self):
        """Reset deformation and velocity gradient."""
        for p in self.x:
            self.F[p] = ti.Matrix.identity(ti.f32, 3)
            self.C[p] = ti.Matrix.zero(ti.f32, 3, 3)

    @ti.kernel
    def scatter(self):
        """Update deformation and transfer momentum from particles to the grid."""
        ti.loop_config(block_dim=256)
        for p in self.x:
            base = ti.cast(self.x[p] / self.dx - 0.5, ti.i32)
            f = self.x[p] / self.dx - ti.cast(base, ti.f32)
            w = [0.5 * (1.5 - f) ** 2, 0.75 - (f - 1.0) ** 2, 0.5 * (f - 0.5) ** 2]
            F = (ti.Matrix.identity(ti.f32, 3) + self.dt * self.C[p]) @ self.F[p]
            self.F[p] = F
            J = F.determinant()
            R = F
            for _ in ti.static(range(POLAR_STEPS)):
                R = 0.5 * (R + R.inverse().transpose())
            tau = 2 * self.mu * (F - R) @ F.transpose()
            tau += ti.Matrix.identity(ti.f32, 3) * (self.lam * J * (J - 1))
            Q = (-self.dt * self.volume * 4 / self.dx**2) * tau + self.mass * self.C[p]
            for i, j, k in ti.static(ti.ndrange(3, 3, 3)):
                arm = (ti.Vector([i, j, k], ti.f32) - f) * self.dx
                weight = w[i][0] * w[j][1] * w[k][2]
                momentum = weight * (self.mass * self.v[p] + Q @ arm)
                node = base + ti.Vector([i, j, k])
                self.grid[node] += ti.Vector(
                    [momentum[0], momentum[1], momentum[2], weight * self.mass]
                )

    @ti.kernel
    def gather(self):
        """Compute grid velocities and transfer them to the particles."""
        for node in ti.grouped(self.grid):
            m = self.grid[node][3]
            if m > 0:
                g = self.grid[node]
                self.grid[node] = ti.Vector(
                    [g[0] / m, g[1] / m, g[2] / m + self.dt * self.gravity, m], ti.f32
                )
        ti.loop_config(block_dim=256)
        for p in self.x:
            base = ti.cast(self.x[p] / self.dx - 0.5, ti.i32)
            f = self.x[p] / self.dx - ti.cast(base, ti.f32)
            w = [0.5 * (1.5 - f) ** 2, 0.75 - (f - 1.0) ** 2, 0.5 * (f - 0.5) ** 2]
            v = ti.Vector.zero(ti.f32, 3)
            C = ti.Matrix.zero(ti.f32, 3, 3)
            for i, j, k in ti.static(ti.ndrange(3, 3, 3)):
                arm = (ti.Vector([i, j, k], ti.f32) - f) * self.dx
                weight = w[i][0] * w[j][1] * w[k][2]
                g = self.grid[base + ti.Vector([i, j, k])]
                seen = ti.Vector([g[0], g[1], g[2]])
                v += weight * seen
                C += 4 / self.dx**2 * weight * seen.outer_product(arm)
            self.v[p] = v
            self.C[p] = C
            self.x[p] += self.dt * v
