"""Contact of the ego box with the boxes of objects."""

from __future__ import annotations

from dataclasses import dataclass

from ...geometry.box_kernels import boxes_overlap
from ..agents import Agents
from ..path import Float
from .contact_kernels import shifted, within_reach

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
    T_world_box: Float = shifted(T_world_vehicle, length / 2 - REAR_OVERHANG, height / 2)
    return T_world_box


def touching(T_world_box: Float, size: tuple[float, float, float], agents: Agents) -> list[int]:
    """Places in ``agents`` of the objects whose boxes overlap the ego box."""
    if not agents.objects:
        return []
    transforms, sizes = agents.transforms, agents.sizes
    near = within_reach(T_world_box, size, transforms, sizes).tolist()
    return [k for k in near if boxes_overlap(T_world_box, size, transforms[k], sizes[k])]
