"""How much of a scene's surfaces its images saw, from the uncertainties of its Gaussians."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray

from ..geometry import Float, invert_transform, quaternion_to_matrix
from .cloud import UNSEEN, GaussianCloud
from .trajectory import Trajectory

SEEN = 0.8 * UNSEEN
"""Uncertainty below which a Gaussian counts as seen. Rays that leak through a surface lower the
value of what is behind it by a little.
"""

AZIMUTHS = 72
"""Directions around an object for which the share of its seen surface is cached."""

MARGIN = 0.25
"""The ground of a box reaches this far beyond it [m]."""

LOW = 0.25
"""The ground's Gaussians are less than this above or below the box's bottom [m]."""


@dataclass(frozen=True, eq=False)
class Coverage:
    """Seen shares of objects and of the ground below them; computed on first use, then cached.

    A Gaussian counts by its opacity times the area of its largest ellipse.

    Attributes:
        background: in the world frame, with uncertainties.
        objects: Gaussians by id, in the object's frame; those without uncertainties have no shares.
        ego: the recorded drive.
    """

    background: GaussianCloud
    objects: Mapping[str, GaussianCloud]
    ego: Trajectory
    _sides: dict[str, Float] = field(default_factory=dict, init=False, repr=False)
    _grounds: dict[str, float] = field(default_factory=dict, init=False, repr=False)

    def of_side(self, object_id: str, azimuth: float) -> float:
        """Share in [0, 1] that images saw of the surface towards ``azimuth`` [rad] in the object's
        frame; nan if there is none or if it is unknown.
        """
        if object_id not in self._sides:
            self._sides[object_id] = _side_shares(self.objects.get(object_id))
        place = round(azimuth / (2 * np.pi) * AZIMUTHS) % AZIMUTHS
        return float(self._sides[object_id][place])

    def of_ground(
        self, object_id: str, poses: Iterable[Float], size: tuple[float, float, float]
    ) -> float:
        """Share in [0, 1] that images saw of the ground below an object; nan without any.

        Args:
            object_id: key of the cached share.
            poses: recorded ``T_world_object`` [4, 4] of the box.
            size: (length, width, height) of the box [m].
        """
        if object_id not in self._grounds:
            self._grounds[object_id] = self._ground_share(poses, size)
        return self._grounds[object_id]

    def _ground_share(self, poses: Iterable[Float], size: tuple[float, float, float]) -> float:
        if self.background.uncertainties is None:
            return float("nan")
        axis, order, along = self._sorted
        means = self.background.means.cpu().numpy()
        half, beneath = np.array(size) / 2, [np.zeros(0, dtype=np.int64)]
        reach = float(np.hypot(half[0], half[1])) + MARGIN
        for T_world_box in poses:
            at = T_world_box[axis, 3]
            low, high = np.searchsorted(along, np.array([at - reach, at + reach], along.dtype))
            near = order[low:high]
            T_box_world = invert_transform(T_world_box)
            local = means[near] @ T_box_world[:3, :3].T + T_box_world[:3, 3]
            inside = (np.abs(local[:, :2]) <= half[:2] + MARGIN).all(axis=1)
            beneath.append(near[inside & (np.abs(local[:, 2] + half[2]) <= LOW)])
        ground = self.background.select(torch.from_numpy(np.unique(np.concatenate(beneath))))
        return float(_shares(_areas(ground)[:, None], _seen(ground))[0])

    @cached_property
    def _sorted(self) -> tuple[int, NDArray[np.int64], NDArray[np.float32]]:
        """The axis, x or y, along which the background is longer; the indices that sort the
        background along it, and the coordinates in that order [m].
        """
        means = self.background.means[:, :2].cpu().numpy()
        axis = int(np.ptp(means, axis=0).argmax()) if len(means) else 0
        order = means[:, axis].argsort()
        return axis, order, means[order, axis]


def _side_shares(cloud: GaussianCloud | None) -> Float:
    """[AZIMUTHS] share of the seen surface by direction; nan without a surface."""
    if cloud is None or cloud.uncertainties is None:
        return np.full(AZIMUTHS, np.nan)
    scales = cloud.scales.cpu().numpy()
    rotations = quaternion_to_matrix(cloud.quats.cpu().numpy())
    shortest = scales.argmin(axis=1)
    normals = np.take_along_axis(rotations, shortest[:, None, None], axis=2)[..., 0]
    outwards = np.where((normals * cloud.means.cpu().numpy()).sum(axis=1) < 0, -1.0, 1.0)
    turns = 2 * np.pi * np.arange(AZIMUTHS) / AZIMUTHS
    towards = outwards[:, None] * normals[:, :2] @ np.stack([np.cos(turns), np.sin(turns)])
    shown = _areas(cloud)[:, None] * np.clip(towards, 0.0, None)
    return _shares(shown, _seen(cloud))


def _areas(cloud: GaussianCloud) -> NDArray[np.float64]:
    scales = np.sort(cloud.scales.cpu().numpy().astype(np.float64), axis=1)
    areas: Float = cloud.opacities.cpu().numpy() * scales[:, 1] * scales[:, 2]
    return areas


def _seen(cloud: GaussianCloud) -> NDArray[np.bool_]:
    assert cloud.uncertainties is not None
    seen: NDArray[np.bool_] = cloud.uncertainties.cpu().numpy() < SEEN
    return seen


def _shares(weights: Float, seen: NDArray[np.bool_]) -> Float:
    """[K] share of the weights [N, K] that belongs to what was ``seen`` [N]."""
    total = weights.sum(axis=0)
    shares: Float = np.full_like(total, np.nan)
    np.divide(weights[seen].sum(axis=0), total, out=shares, where=total > 0)
    return shares
