"""Contact of the ego box with the boxes of objects."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..scene.box import boxes_overlap
from .agents import Agents
from .path import Float

REAR_OVERHANG = 0.95
"""Distance from the rear axle to the rear end of the ego box [m]. Recorders store the box size but
not where the axle lies in it; 0.95 m is usual for passenger cars between 4.3 and 4.9 m long."""


@dataclass(frozen=True)
class Contact:
    """One object whose box began to overlap the ego box.

    Attributes:
        object_id: the object; None for the background.
        relative_speed: length of the difference of the two velocities [m/s].
    """

    object_id: str | None
    relative_speed: float


def ego_box(T_world_vehicle: Float, size: tuple[float, float, float]) -> Float:
    """``T_world_box`` [4, 4] of the ego box, whose bottom is on the ground."""
    length, _, height = size
    T_world_box = T_world_vehicle.copy()
    T_world_box[:3, 3] += T_world_vehicle[:3, :3] @ [length / 2 - REAR_OVERHANG, 0.0, height / 2]
    return T_world_box


def touching(T_world_box: Float, size: tuple[float, float, float], agents: Agents) -> list[int]:
    """Places in ``agents`` of the objects whose boxes overlap the ego box."""
    if not agents.objects:
        return []
    sizes = agents.sizes
    reach = np.sqrt(np.sum(sizes * sizes, axis=1)) / 2
    local = np.abs((agents.positions - T_world_box[:3, 3]) @ T_world_box[:3, :3])
    near = np.flatnonzero((local < np.array(size) / 2 + reach[:, None]).all(axis=1))
    if not len(near):
        return []
    hit = boxes_overlap(T_world_box, size, agents.transforms[near], sizes[near])
    return [int(i) for i in near[hit]]
