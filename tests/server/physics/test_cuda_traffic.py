"""Bytes moved by a substep against the lower bound; and what a substep does not read."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from real2sim_server.physics.backends.cuda import launcher as records
from real2sim_server.physics.backends.cuda.launcher import Launch
from real2sim_server.physics.backends.cuda.memory import substep_traffic
from real2sim_server.physics.backends.layout import arrange

from ..render.kernel_twin import COMPILER, NEEDS_COMPILER
from .on_twin import on_twin
from .scenes import cube, solve


def block_of_a_million(cells: int) -> dict[str, int]:
    """Layout of a cube of a million particles, ``cells`` of them per grid cell."""
    along = (np.arange(100) + 0.37) / cells ** (1 / 3)
    positions = np.stack(np.meshgrid(along, along, along, indexing="ij"), axis=-1).reshape(-1, 3)
    blocks = np.floor((positions - 0.5) / 4).astype(np.int64)
    _, layout = arrange(
        blocks, np.zeros(len(blocks), np.int64), np.zeros(len(blocks), np.int16), 1.0, []
    )
    nodes = int(np.ptp(np.floor(along - 0.5))) + 3
    return {
        "particles": len(positions),
        "blocks": len(layout.block_coordinates),
        "fields": len(layout.field_coordinates),
        "nodes": nodes**3,
    }


@pytest.mark.parametrize("plastic", [False, True])
@pytest.mark.parametrize("cells", [8, 14])
def test_a_substep_moves_less_than_2_5_times_the_lower_bound(cells: int, plastic: bool) -> None:
    traffic = substep_traffic(**block_of_a_million(cells), plastic=plastic)
    assert traffic.moved < 2.5 * traffic.floor


@pytest.mark.skipif(COMPILER is None, reason=NEEDS_COMPILER)
def test_a_substep_does_not_read_what_it_recomputes() -> None:
    ends = []
    for spoilt in (False, True):
        run = on_twin(lambda: solve([cube(edge=0.1, velocity=(1, 0, 0))], precision="single"))
        simulation: Any = run.simulation
        memory, launcher = simulation._memory, simulation._launcher
        memory.upload_step(1e-4, False, simulation._rows(1, 1e-4, []))
        sizes = memory.sizes
        launcher.run((Launch("advance_blocks", sizes.blocks, records.SCATTERS),), memory.space)
        if spoilt:
            held = torch.from_numpy(memory.values(memory.sets[simulation._current].numpy()))
            for first, end in (
                (records.VELOCITY, records.ELASTIC_F),
                (records.STRESS, records.HISTORY),
            ):
                held[first:end] = float("nan")
        moving = Launch(
            "advance_blocks", sizes.blocks, records.MOVES | records.DEFORMS | records.SCATTERS
        )
        launcher.run((Launch("collect_fields", sizes.fields), moving), memory.space)
        ends.append(simulation.particles())
    for name in ("positions", "velocities", "gradients", "F_elastic"):
        assert getattr(ends[0], name).tobytes() == getattr(ends[1], name).tobytes()
