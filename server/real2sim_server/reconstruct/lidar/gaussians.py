"""The Gaussians of a set for LiDARs in the making: background and objects as one table."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import torch
from numpy.typing import NDArray

from ...geometry.transform import quaternion_to_matrix
from ...scene import GaussianCloud, LidarSurfaces, Reflector, Scene

Array = NDArray[np.float32]
MOST_OPAQUE = 0.99


@dataclass(eq=False)
class SurfaceTable:
    """Flat Gaussians of all bodies; the last axis of each is its normal.

    Attributes:
        object_ids: of the bodies after the background.
        firsts: [bodies + 1] int64, where each body begins.
        means, quats, axes, scales: [N, 3], [N, 4], [N, 3, 3] and [N, 3] float32, as laid out.
        logit, size, shift: [N] float32, what is learned: logit of the opacity, logarithm of the
            factor of the scales along the surface, shift along the normal [m].
        attributes: [N, 2] float32, see ``Reflector``.
    """

    object_ids: tuple[str, ...]
    firsts: NDArray[np.int64]
    means: Array
    quats: Array
    axes: Array
    scales: Array
    logit: Array
    size: Array = field(init=False)
    shift: Array = field(init=False)
    attributes: Array = field(init=False)

    def __post_init__(self) -> None:
        count = len(self.means)
        self.size, self.shift = np.zeros((2, count), np.float32)
        self.attributes = np.zeros((count, 2), np.float32)

    @classmethod
    def of(cls, clouds: list[GaussianCloud], object_ids: tuple[str, ...]) -> SurfaceTable:
        """The table of clouds, background first."""
        means, quats, scales, opacities = (
            np.concatenate([getattr(cloud, name).numpy() for cloud in clouds])
            for name in ("means", "quats", "scales", "opacities")
        )
        axes = quaternion_to_matrix(quats).astype(np.float32)
        opacities = np.clip(opacities, 0.01, MOST_OPAQUE)
        firsts = np.cumsum([0, *map(len, clouds)]).astype(np.int64)
        return cls(
            object_ids, firsts, means, quats, axes, scales, np.log(opacities / (1 - opacities))
        )

    def __len__(self) -> int:
        return len(self.means)

    @property
    def opacities(self) -> Array:
        """[N] as learned."""
        return np.minimum(1 / (1 + np.exp(-self.logit)), MOST_OPAQUE).astype(np.float32)

    @property
    def body_of(self) -> NDArray[np.int32]:
        """[N], body of each Gaussian."""
        bodies = np.arange(len(self.firsts) - 1, dtype=np.int32)
        return np.repeat(bodies, np.diff(self.firsts))

    def placed(self, scene: Scene, incidence: float = 1.0) -> Scene:
        """The scene with this set for LiDARs."""
        wide = np.exp(self.size)[:, None]
        scales = np.concatenate([self.scales[:, :2] * wide, self.scales[:, 2:]], axis=1)
        means = self.means + self.axes[:, :, 2] * self.shift[:, None]
        columns = (means, self.quats, scales, self.opacities)
        parts = []
        for body in range(len(self.firsts) - 1):
            part = slice(self.firsts[body], self.firsts[body + 1])
            own = (torch.from_numpy(np.ascontiguousarray(column[part])) for column in columns)
            means_of, quats, scales_of, opacities = own
            cloud = GaussianCloud(
                means_of, quats, scales_of, opacities, sh=torch.zeros(len(means_of), 1, 3)
            )
            attributes = torch.from_numpy(self.attributes[part].copy())
            parts.append(Reflector(cloud, attributes))
        objects = dict(zip(self.object_ids, parts[1:], strict=True))
        return replace(scene, lidar=LidarSurfaces(parts[0], objects, incidence), content_hash="")

    def select(self, kept: NDArray[np.bool_]) -> SurfaceTable:
        """The Gaussians of a mask, as far as they have been learned."""
        counts = np.bincount(self.body_of[kept], minlength=len(self.firsts) - 1)
        laid_out = (
            getattr(self, name)[kept] for name in ("means", "quats", "axes", "scales", "logit")
        )
        made = SurfaceTable(self.object_ids, np.cumsum([0, *counts]).astype(np.int64), *laid_out)
        for name in ("size", "shift", "attributes"):
            setattr(made, name, getattr(self, name)[kept])
        return made
