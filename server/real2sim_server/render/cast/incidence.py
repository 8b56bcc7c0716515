"""How squarely surfaces face the LiDAR, and what they send back for it."""

from __future__ import annotations

import weakref

import numpy as np
from numpy.typing import NDArray

from ...geometry.rotation import Float, quaternion_to_matrix
from ...geometry.transform import invert_transform
from ...scene import Beams, GaussianCloud
from ..backends.cpu.inputs import array_of
from .cpu.layout import AZIMUTH_BINS, layout_of
from .types import CastRequest

Array = NDArray[np.float32]
_normals: weakref.WeakKeyDictionary[GaussianCloud, Array] = weakref.WeakKeyDictionary()


def facing(cloud: GaussianCloud, beams: Beams, T_cloud_lidar: Float) -> Array:
    """Cosine [N] of the angle between each Gaussian's shortest axis and the light on its centre.

    Args:
        cloud: in its own frame.
        beams: of the sensor.
        T_cloud_lidar: [S, 4, 4] pose of the sensor in that frame at each instant of the sweep.
    """
    means = array_of(cloud.means)
    middle = invert_transform(T_cloud_lidar[len(T_cloud_lidar) // 2])[:2].astype(np.float32)
    across = means @ middle[:, :3].T + middle[:, 3]
    azimuth = np.arctan2(across[:, 1], across[:, 0])
    bins = ((azimuth + np.float32(np.pi)) * np.float32(AZIMUTH_BINS / (2 * np.pi))).astype(np.int32)
    slots = layout_of(beams).slot_of[np.clip(bins, 0, AZIMUTH_BINS - 1)]
    away = means - T_cloud_lidar[:, :3, 3].astype(np.float32)[slots]
    across_surface = np.abs(np.einsum("ni,ni->n", away, normals_of(cloud)))
    distance = np.sqrt(np.einsum("ni,ni->n", away, away))
    cosine: Array = across_surface / np.maximum(distance, np.float32(1e-6))
    return cosine


def facing_of_request(request: CastRequest) -> list[Array]:
    """``facing`` of the Gaussians of each instance."""
    return [_facing_of(request, index) for index in range(len(request.instances))]


def attributes_towards(request: CastRequest, incidence: float) -> tuple[Array | None, ...]:
    """Attributes of a request with the reflectivity that Gaussians have towards its sensor."""
    alike = np.float32(incidence)
    found: list[Array | None] = []
    for index, given in enumerate(request.attributes):
        if given is not None:
            towards = given[:, 0] * (alike + (1 - alike) * _facing_of(request, index))
            found.append(np.stack([towards, given[:, 1]], axis=1))
        else:
            found.append(None)
    return tuple(found)


def _facing_of(request: CastRequest, index: int) -> Array:
    instance, poses = request.instances[index], request.object_poses[index]
    placed = instance.T_world_object if poses is None else poses
    T_cloud_world = np.eye(4) if placed is None else invert_transform(np.asarray(placed))
    return facing(instance.cloud, request.lidar.beams, T_cloud_world @ request.T_world_lidar)


def normals_of(cloud: GaussianCloud) -> Array:
    """Shortest axes [N, 3]; kept as long as the cloud."""
    known = _normals.get(cloud)
    if known is None:
        shortest = array_of(cloud.scales).argmin(1)
        axes = quaternion_to_matrix(array_of(cloud.quats)).astype(np.float32)
        normals = np.take_along_axis(axes, shortest[:, None, None], axis=2)[:, :, 0]
        known = _normals[cloud] = np.ascontiguousarray(normals)
    return known
