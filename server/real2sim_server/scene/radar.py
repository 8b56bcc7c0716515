"""Radars: what they resolve, and the rays by which they look for targets."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from real2sim_proto.ranging import RadarModel

from ..geometry.transform import Float, is_rigid
from .errors import RadarError
from .lidar import Beams, Lidar

RADARS: Mapping[str, RadarModel] = {
    "mid-range": RadarModel(),
    "long-range": RadarModel(
        range_m=(0.5, 280.0),
        field_of_view_deg=(50.0, 12.0),
        azimuth_resolution_deg=1.0,
        elevation_resolution_deg=12.0,
        detection_range_m=250.0,
        ray_spacing_deg=0.2,
    ),
    "corner": RadarModel(
        range_m=(0.3, 80.0),
        field_of_view_deg=(150.0, 24.0),
        range_resolution_m=0.3,
        azimuth_resolution_deg=4.0,
        elevation_resolution_deg=24.0,
        detection_range_m=70.0,
        ray_spacing_deg=0.6,
    ),
    "imaging": RadarModel(
        range_m=(0.5, 250.0),
        field_of_view_deg=(110.0, 24.0),
        range_resolution_m=0.2,
        azimuth_resolution_deg=1.0,
        elevation_resolution_deg=2.0,
        detection_range_m=200.0,
        ray_spacing_deg=0.3,
    ),
}
"""Radars of 77 GHz of four kinds, by orders of magnitude; no maker's figures."""

MOUNT = (3.6, 0.0, 0.5)
"""Of radars whose session names no pose, from the vehicle's rear axle [m]."""


def at_mount() -> Float:
    """``T_vehicle_radar`` [4, 4] at MOUNT, looking ahead."""
    pose = np.eye(4)
    pose[:3, 3] = MOUNT
    return pose


def catalogue_radar(name: str) -> RadarModel:
    """The radar of that name in the catalogue.

    Raises:
        RadarError: it has none; with those it has.
    """
    if name not in RADARS:
        raise RadarError(f"no radar {name!r} in the catalogue; it has {', '.join(RADARS)}")
    return RADARS[name]


@dataclass(frozen=True, eq=False)
class Radar:
    """A radar on the vehicle.

    Attributes:
        name: unique on its vehicle.
        model: what it resolves and detects.
        T_vehicle_radar: [4, 4] float64, sensor frame x along its axis, y left, z up.

    Raises:
        RadarError: the pose is no rigid transform.
    """

    name: str
    model: RadarModel
    T_vehicle_radar: Float = field(default_factory=at_mount)

    def __post_init__(self) -> None:
        pose = np.array(self.T_vehicle_radar, dtype=np.float64)
        if not is_rigid(pose):
            raise RadarError(f"radar {self.name!r}: T_vehicle_radar is not a rigid transform")
        object.__setattr__(self, "T_vehicle_radar", pose)

    @cached_property
    def rays(self) -> Lidar:
        """The fan of rays that finds what there is to see, all at one instant, [B, C]."""
        model = self.model
        wide, high = (
            max(round(angle / model.ray_spacing_deg), 1) for angle in model.field_of_view_deg
        )
        azimuth = _steps(model.field_of_view_deg[0], wide)
        elevation = _steps(model.field_of_view_deg[1], high)
        shape = (high, wide)
        beams = Beams(
            np.broadcast_to(azimuth, shape),
            np.broadcast_to(elevation[:, None], shape),
            np.zeros(shape),
        )
        near, far = model.range_m
        return Lidar(
            self.name,
            beams,
            self.T_vehicle_radar,
            min_range=near,
            max_range=far,
        )

    @property
    def solid_angle(self) -> float:
        """That of one ray on the axis [sr]."""
        wide, high = (
            np.radians(angle) / count
            for angle, count in zip(
                self.model.field_of_view_deg, self.rays.shape[::-1], strict=True
            )
        )
        return float(wide * high)


def _steps(degrees: float, count: int) -> Float:
    """Centres of ``count`` steps over an angle about 0 [rad]."""
    centres: Float = np.radians(degrees) * ((np.arange(count) + 0.5) / count - 0.5)
    return centres
