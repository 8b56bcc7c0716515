"""What goes into cast() and what comes out."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ...geometry.rotation import Float
from ...scene import Lidar
from ..types import Instance

TRANSMITTANCE_MIN = 1e-3
"""A ray ends where so little of its light is left."""
HALF_LIGHT = 0.5
"""A ray has met a surface where its transmittance falls to this or below."""
ECHO_MIN = 0.05
"""Echoes with a smaller share of the light are no return."""

Image = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class CastRequest:
    """A checked cast() call. A sweep has S instants, see ``Beams.slots``.

    Attributes:
        instances: what the light meets; ``T_world_object`` is where each stands at the sweep's
            time stamp.
        lidar: the sensor.
        T_world_lidar: [S, 4, 4] float64 at each instant.
        object_poses: for each instance [S, 4, 4] float64, or None where it stands still.
        attributes: for each instance [N, 2] float32, reflectivity and share of lost rays of its
            Gaussians, or None where nobody knows them.
    """

    instances: tuple[Instance, ...]
    lidar: Lidar
    T_world_lidar: Float
    object_poses: tuple[Float | None, ...]
    attributes: tuple[NDArray[np.float32] | None, ...]


@dataclass(frozen=True, eq=False)
class Return:
    """One of several returns of each ray.

    Attributes:
        range: along the ray [m]; 0 where there is none.
        power: share of the ray's light that comes back from there, two ways, 0 to 1.
        intensity: reflectivity there.
    """

    range: Image
    power: Image
    intensity: Image


@dataclass(frozen=True, eq=False)
class Echo:
    """What the light of each ray meets, before the detector. All arrays are of the LiDAR's shape.

    Attributes:
        range: where the light has fallen to a half (median) [m]; 0 where it never does.
        expected: mean range over all light that was stopped [m]; 0 where none was.
        opacity: share of the light that was stopped, 0 to 1.
        intensity: reflectivity, mean over that light.
        drop: share of lost rays, the same mean.
        instance: uint16, instance_id at the median; 0 where there is none.
        member: int32, number of the Gaussian at the median, counted over all instances in their
            order; -1 where there is none.
        returns: ``first`` and ``last``, and ``strongest`` of three; empty of a single return.
        timing_ms: milliseconds by stage.
    """

    range: Image
    expected: Image
    opacity: Image
    intensity: Image
    drop: Image
    instance: NDArray[np.uint16]
    member: NDArray[np.int32]
    returns: dict[str, Return] = field(default_factory=dict)
    timing_ms: dict[str, float] = field(default_factory=dict)

    @property
    def hit(self) -> NDArray[np.bool_]:
        """Rays that lose half of their light or more."""
        return self.range > 0


@dataclass(frozen=True, eq=False)
class Meetings:
    """Which Gaussians rays meet, from near to far.

    Attributes:
        begins: [R + 1] int64, where the meetings of each ray begin among all M.
        members: [M] int32, numbers of the Gaussians, counted over all instances in their order.
        alpha: [M] float32, share of the arriving light that is stopped.
        tau: [M] float32, where [m].
    """

    begins: NDArray[np.int64]
    members: NDArray[np.int32]
    alpha: Image
    tau: Image


class CastBackend(Protocol):
    """One way to cast. All members give the same echoes within rounding."""

    name: str

    def cast(self, request: CastRequest) -> Echo:
        """Follow every ray."""
        ...
