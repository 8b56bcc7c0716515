"""The box of the ego vehicle, which stands on the ground."""

from __future__ import annotations

from ..broad_phase_kernels import shifted
from ..path import Float

REAR_OVERHANG = 0.95
"""Distance from the rear axle to the rear end of the ego box [m]. Recorders store the box size but
not where the axle lies in it; 0.95 m is usual for passenger cars between 4.3 and 4.9 m long."""


def ego_box(T_world_vehicle: Float, size: tuple[float, float, float]) -> Float:
    """``T_world_box`` [4, 4] of the ego box, whose bottom is on the ground."""
    length, _, height = size
    T_world_box: Float = shifted(T_world_vehicle, length / 2 - REAR_OVERHANG, height / 2)
    return T_world_box
