"""Gaussians that only LiDARs see, with a reflectivity each.

Gaussians trained on images alone are haze to a beam. A scene can therefore contain a second set,
made from the recorded sweeps and visible to LiDARs only.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .cloud import GaussianCloud
from .errors import SceneError

MAX_REFLECTIVITY = 4.0
"""Reflectivity of retroreflectors (signs, number plates)."""
RANGE_STEPS = (
    *(0.0, 1.5, 2.0, 2.25, 2.5, 2.75, 3.0, 3.25, 3.5, 3.75, 4.0, 4.5, 5.0, 5.5, 6.0, 7.0, 8.0),
    *(9.0, 10.0, 12.0, 14.0, 17.0, 20.0, 25.0, 30.0, 40.0, np.inf),
)
"""Range steps with the same response of a ring [m]."""


@dataclass(frozen=True, eq=False)
class Reflector:
    """Gaussians as a LiDAR sees them.

    Attributes:
        cloud: cloud in the frame of the background or of the object. Its uncertainties are
            UNSEEN / (1 + number of recorded beams that a Gaussian stops).
        attributes: [N, 2] float32: reflectivity at normal incidence, 0 to MAX_REFLECTIVITY, and
            share of lost rays, 0 to 1.

    Raises:
        SceneError: attributes of another shape or type.
    """

    cloud: GaussianCloud
    attributes: Tensor

    def __post_init__(self) -> None:
        expected = (len(self.cloud), 2)
        if tuple(self.attributes.shape) != expected or self.attributes.dtype != torch.float32:
            raise SceneError(
                f"attributes for a LiDAR must be {expected} float32, not "
                f"{tuple(self.attributes.shape)} {self.attributes.dtype}"
            )

    def to(self, device: torch.device | str) -> Reflector:
        """The same on another device."""
        return Reflector(self.cloud.to(device), self.attributes.to(device))

    def check_values(self, what: str) -> None:
        """Check every value. Raises SceneError with the count of bad ones."""
        self.cloud.check_values(what)
        most = torch.tensor([MAX_REFLECTIVITY, 1.0], device=self.attributes.device)
        bad = ~((self.attributes >= 0) & (self.attributes <= most))
        if bool(bad.any()):
            raise SceneError(
                f"{what}: {int(bad.sum())} attributes are outside [0, {MAX_REFLECTIVITY:g}] "
                "(reflectivity) or [0, 1] (lost rays)"
            )


@dataclass(frozen=True, eq=False)
class RingResponse:
    """Response of the recording sensor to reflectivity, by ring and range.

    The lasers of a sensor differ, and their calibration varies with the range. A recorded intensity
    is ``gain * reflectivity + offset``.

    Attributes:
        elevation: [B] of the rings, as the scan lists them [rad].
        gain, offset: [B, K], one column per interval of RANGE_STEPS.

    Raises:
        SceneError: shapes that differ, or values that are not finite.
    """

    elevation: NDArray[np.float32]
    gain: NDArray[np.float32]
    offset: NDArray[np.float32]

    def __post_init__(self) -> None:
        expected = (len(self.elevation), len(RANGE_STEPS) - 1)
        for name in ("gain", "offset"):
            shape = getattr(self, name).shape
            if shape != expected:
                raise SceneError(f"{name} of a LiDAR's response must be {expected}, not {shape}")
        if not all(np.isfinite(a).all() for a in (self.elevation, self.gain, self.offset)):
            raise SceneError("a LiDAR's response holds values that are not finite")

    def applied(
        self,
        reflectivity: NDArray[np.float32],
        *,
        elevation: NDArray[np.float64],
        ring: NDArray[np.int32],
        distance: NDArray[np.float32],
    ) -> NDArray[np.float32]:
        """Intensities [R] of the sensor for reflectivities [R].

        Args:
            elevation: [B'] of the rings of a sweep [rad].
            ring: [R], of each ray; -1 for rays without a ring.
            distance: [R] range [m].
        """
        row, step = self.rows(self.elevation, elevation, ring), self.step_of(distance)
        answered = self.gain[row, step] * reflectivity + self.offset[row, step]
        return np.where(ring >= 0, answered, reflectivity).astype(np.float32)

    @staticmethod
    def rows(
        known: NDArray[np.floating], elevation: NDArray[np.floating], ring: NDArray[np.int32]
    ) -> NDArray[np.int64]:
        """Index of each ray's ring in ``known``: the same number if the counts of rings are equal,
        otherwise the ring of nearest elevation; 0 for rays without a ring.
        """
        if len(known) == len(elevation):
            return np.maximum(ring, 0).astype(np.int64)
        nearest = np.abs(elevation[:, None] - known).argmin(1).astype(np.int64)
        return np.asarray(nearest[np.maximum(ring, 0)])

    @staticmethod
    def step_of(distance: NDArray[np.floating]) -> NDArray[np.int64]:
        """Column of each range [m]."""
        return np.searchsorted(RANGE_STEPS[1:-1], distance, side="right")


@dataclass(frozen=True, eq=False)
class LidarSurfaces:
    """The second set of Gaussians of a scene, for LiDARs.

    Attributes:
        background: background in the world frame.
        objects: by object id, in the object's frame; a missing object shows its own Gaussians.
        incidence: share of reflected light that is independent of the incidence, 0 to 1; the rest
            is proportional to the cosine.
        response: response of the sensor that recorded the log, if its scans have rings.

    Raises:
        SceneError: a share outside 0 to 1.
    """

    background: Reflector
    objects: Mapping[str, Reflector] = field(default_factory=dict)
    incidence: float = 1.0
    response: RingResponse | None = None

    def __post_init__(self) -> None:
        if not 0 <= self.incidence <= 1:
            raise SceneError(f"incidence of a LiDAR's set must be 0 to 1, not {self.incidence!r}")
        object.__setattr__(self, "objects", MappingProxyType(dict(self.objects)))

    def to(self, device: torch.device | str) -> LidarSurfaces:
        """The set on another device."""
        objects = {object_id: part.to(device) for object_id, part in self.objects.items()}
        return replace(self, background=self.background.to(device), objects=objects)

    @property
    def gaussian_count(self) -> int:
        """Number of Gaussians in background and objects."""
        return len(self.background.cloud) + sum(len(o.cloud) for o in self.objects.values())

    @property
    def nbytes(self) -> int:
        """Memory of the set [bytes]."""
        parts = [self.background, *self.objects.values()]
        return sum(p.cloud.nbytes + 8 * len(p.cloud) for p in parts)
