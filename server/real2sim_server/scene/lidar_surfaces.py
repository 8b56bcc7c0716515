"""What the LiDAR of a scene sees: Gaussians of its own, with a reflectivity each.

Images and LiDAR ask different things of Gaussians: those trained on images alone are haze to a
beam. So a scene may hold a second set, made of the recorded sweeps, that only LiDARs look at.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

import torch
from torch import Tensor

from .cloud import GaussianCloud
from .errors import SceneError


@dataclass(frozen=True, eq=False)
class Reflector:
    """Gaussians that a LiDAR sees.

    Attributes:
        cloud: in the frame of the background or of the object.
        attributes: [N, 2] float32 on the CPU: reflectivity, and share of rays lost there, both
            0 to 1.

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

    def check_values(self, what: str) -> None:
        """Look at every value. Raises SceneError with the count of bad ones."""
        self.cloud.check_values(what)
        bad = ~((self.attributes >= 0) & (self.attributes <= 1))
        if bool(bad.any()):
            raise SceneError(f"{what}: {int(bad.sum())} attributes are outside [0, 1]")


@dataclass(frozen=True, eq=False)
class LidarSurfaces:
    """The second set of a scene.

    Attributes:
        background: in the world.
        objects: by object id, in the object's frame; an object that is missing shows its own
            Gaussians.
    """

    background: Reflector
    objects: Mapping[str, Reflector] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "objects", MappingProxyType(dict(self.objects)))

    @property
    def gaussian_count(self) -> int:
        """Gaussians of all."""
        return len(self.background.cloud) + sum(len(o.cloud) for o in self.objects.values())

    @property
    def nbytes(self) -> int:
        """Memory of all [bytes]."""
        parts = [self.background, *self.objects.values()]
        return sum(p.cloud.nbytes + 8 * len(p.cloud) for p in parts)
