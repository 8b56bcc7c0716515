"""Bytes that a substep moves between memory and multiprocessors, counted and not measured."""

from __future__ import annotations

from dataclasses import dataclass

from . import records as r

_KEYS, _INDEX = 8, 4


@dataclass(frozen=True)
class Traffic:
    """Of one substep, every array read or written by a kernel counted whole.

    Attributes:
        particles: positions, deformation, stress, velocities of particles.
        tiles: what blocks scatter, written and read.
        velocities: of nodes, written once and read by each block around them.
        indices: neighbours of blocks and fields.
        floor: what no order of work can save: position and deformation of a particle read and
            written, its mass, volume and material read, and a node of the grid written and read.
    """

    particles: int
    tiles: int
    velocities: int
    indices: int
    floor: int

    @property
    def moved(self) -> int:
        """All together."""
        return self.particles + self.tiles + self.velocities + self.indices


def substep_traffic(
    *, particles: int, blocks: int, fields: int, nodes: int, plastic: bool, itemsize: int = 4
) -> Traffic:
    """What a substep in the middle of an interval moves where nothing touches.

    Args:
        particles: number of them.
        blocks, fields: of the layout.
        nodes: of the grid that particles give to.
        plastic: whether particles have a total deformation and a history of their own.
        itemsize: bytes of a number, 4 in single precision.
    """
    # Position, F, mass, volume, history are read; position, velocity, gradient, F, stress, energy
    # are written. Material is a word.
    numbers = 3 + 9 + 3 + (3 + 3 + 9 + 9 + 6 + 1)
    least = 2 * (3 + 9) + 2
    if plastic:
        numbers += 9 + 9 + 1
        least += 2 * (9 + 1)
    node = 4 * itemsize
    return Traffic(
        particles=particles * (numbers * itemsize + _INDEX),
        tiles=2 * blocks * r.TILE * node,
        velocities=fields * r.NODES * node + blocks * r.TILE * node,
        indices=(blocks + fields) * (r.AROUND * _INDEX + _KEYS),
        floor=particles * (least * itemsize + _INDEX) + 2 * nodes * node,
    )
