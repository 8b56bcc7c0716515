"""Launches, copies and waits of the solver on the pretended device."""

from __future__ import annotations

import pytest

from real2sim_server.physics import Box, FixedCorotated, Plane, Solver, SolverOptions
from real2sim_server.physics import box_particles as lattice
from real2sim_server.physics.body import Body

from ..physics.kernel_twin import TwinLauncher
from ..physics.on_twin import on_twin
from ..render.kernel_twin import COMPILER, NEEDS_COMPILER
from . import pretended

pytestmark = pytest.mark.skipif(COMPILER is None, reason=NEEDS_COMPILER)


class PretendedLauncher(TwinLauncher):
    """Runs kernels on the values of pretended tensors, and refuses other memory."""

    def __init__(self, precision: str) -> None:
        super().__init__(precision)
        self.device = pretended.DEVICE

    def run(self, launches, space) -> None:
        pretended.counts.launches += len(launches)
        super().run(launches, space)

    def pointer(self, tensor) -> int:
        assert isinstance(tensor, pretended.Pretended), "the kernels were given memory of the host"
        assert tensor.is_contiguous()
        return int(tensor.held.data_ptr())


def dropped() -> Solver:
    """A soft block above the ground, and a box that moves below it."""
    pose = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0.0], [0, 0, 0, 1]]
    block = lattice([0.2] * 3, spacing=0.05, density=200)
    pose_block = [[1, 0, 0, 0.01], [0, 1, 0, 0.02], [0, 0, 1, 0.25], [0, 0, 0, 1]]
    body = Body(name="block", particles=block.moved(pose_block), material=FixedCorotated(young=2e5))
    box = Box(name="box", T_world_box=pose, size=(1, 1, 0.2), velocity=(0.5, 0, 0.1))
    return Solver(
        [body],
        [Plane(name="ground"), box],
        SolverOptions(dx=0.1, dt_max=2.5e-4, precision="single"),
    )


@pytest.fixture
def solver(device_counts: pretended.Counts) -> Solver:
    return on_twin(dropped, PretendedLauncher)


def test_a_check_interval_needs_one_copy_each_way_one_wait_and_two_launches_per_substep(
    solver: Solver, device_counts: pretended.Counts
) -> None:
    simulation = solver.simulation
    simulation.advance(16, 2e-4, solver.colliders)
    device_counts.__init__()  # type: ignore[misc]
    simulation.advance(16, 2e-4, solver.colliders)
    measure = simulation.measure()
    assert simulation.contacts()[0].shape == (1, 2, 8)
    assert measure.finite
    # One to begin, one to scatter, two per substep, four to measure and sum up contacts.
    assert device_counts.launches == 1 + 1 + 2 * 16 + 4
    # Upload the motion of the colliders, and download the report.
    assert device_counts.to_device == 1
    assert device_counts.to_host == 1
    assert device_counts.waits == 1


def test_the_launch_sequence_is_constant(solver: Solver) -> None:
    launcher = solver.simulation._launcher  # type: ignore[attr-defined]
    for _ in range(6):
        solver.simulation.advance(16, 2e-4, solver.colliders)
    # The sequence can be captured once, after the initial sort.
    assert len(set(launcher.sequences[2:])) == 1


def test_steps_checks_and_snapshots_mix_no_devices(solver: Solver) -> None:
    plain = dropped()
    for run in (plain, solver):
        run.step(0.004)
    assert solver.state("block").centre == pytest.approx(plain.state("block").centre, abs=1e-6)
    kept = solver.snapshot()
    solver.step(0.002)
    solver.restore(kept)
    assert solver.particles().positions.shape == plain.particles().positions.shape
