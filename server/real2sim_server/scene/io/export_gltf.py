"""A scene as glTF 2.0 with KHR_gaussian_splatting: a node per object, its track an animation.

Facts: github.com/KhronosGroup/glTF, extensions/2.0/Khronos/KHR_gaussian_splatting, and the glTF 2.0
specification.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ...geometry.transform import Float, invert_transform, matrix_to_quaternion
from ..camera import Camera
from ..cloud import GaussianCloud
from ..scene import Scene, SceneObject
from ..spherical_harmonics import SH_C0
from ..trajectory import Trajectory
from .formats.types import host_array
from .glb import GlbWriter
from .splats import upright

EXTENSION = "KHR_gaussian_splatting"
POINTS = 0

T_OPTICAL_GLTF = np.diag([1.0, -1.0, -1.0, 1.0])
"""Rotation from a glTF camera (y up, looking along -z) to an OpenCV one."""

FAR_PLANE = 1000.0
NEAR_PLANE = 0.05


def write_gltf(
    scene: Scene, path: Path, *, objects: Mapping[str, SceneObject], t_us: int | None
) -> None:
    """Write ``scene`` with ``objects`` as one ``.glb``, atomically.

    The root node turns the scene (z up) to glTF's y up and z forward; below it are the
    ``background``, one node per object named by its id, and ``ego`` with the cameras. Gaussians of
    an object are in its own frame. Without ``t_us`` nodes move by an animation in seconds since
    ``extras.start_us``: translation and rotation LINEAR, as trajectories interpolate, and a STEP
    scale of zero while an object does not exist, which is how glTF hides a node. With ``t_us``
    everything stands as it was at that time, and all of ``objects`` must exist then.

    Scales and opacities are linear, as the extension has it; ``COLOR_0`` lets viewers without
    it show points. The sky and a camera's principal point are not in the file (the latter is in the
    node's ``extras``).

    Raises:
        SceneError: for values that are not finite or out of range, or more than 4 GiB.
        OSError: the file cannot be written.
    """
    scene.background.check_values(f"background for {path}")
    for object_id, scene_object in objects.items():
        scene_object.cloud.check_values(f"object {object_id!r} for {path}")
    builder = _Builder(scene, objects, t_us)
    builder.writer.write(builder.document(), path)


class _Builder:
    """Nodes, meshes and channels of one file."""

    def __init__(self, scene: Scene, objects: Mapping[str, SceneObject], t_us: int | None) -> None:
        self.writer = GlbWriter()
        self.t_us = t_us
        tracks = [scene.ego, *(o.trajectory for o in objects.values())]
        self.start_us = min(t.start_us for t in tracks)
        self.end_us = max(t.end_us for t in tracks)
        self.nodes: list[dict[str, Any]] = []
        self.meshes: list[dict[str, Any]] = []
        self.cameras: list[dict[str, Any]] = []
        self.channels: list[dict[str, Any]] = []
        self.samplers: list[dict[str, Any]] = []
        children = [self._add_cloud_node(scene.background, {"name": "background"})]
        children += [self._add_object(o) for o in objects.values()]
        children.append(self._add_ego(scene))
        self.root = self._add_node(
            {"name": scene.name, "children": children} | _pose(invert_transform(upright("y", 0.0)))
        )
        self.extras = {
            "start_us": self.start_us if t_us is None else t_us,
            "content_hash": scene.content_hash,
        }

    def document(self) -> dict[str, Any]:
        """The JSON part, but for buffers and accessors."""
        document: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": "real2sim", "extras": self.extras},
            "scene": 0,
            "scenes": [{"nodes": [self.root]}],
            "nodes": self.nodes,
        }
        if self.meshes:
            document |= {"extensionsUsed": [EXTENSION], "meshes": self.meshes}
        if self.cameras:
            document["cameras"] = self.cameras
        if self.channels:
            document["animations"] = [
                {"name": "drive", "channels": self.channels, "samplers": self.samplers}
            ]
        return document

    def _add_node(self, node: dict[str, Any]) -> int:
        self.nodes.append(node)
        return len(self.nodes) - 1

    def _add_cloud_node(self, cloud: GaussianCloud, node: dict[str, Any]) -> int:
        # An accessor has at least one element, so nothing is a node without a mesh.
        if len(cloud):
            node["mesh"] = len(self.meshes)
            self.meshes.append({"primitives": [_primitive(self.writer, cloud)]})
        return self._add_node(node)

    def _add_object(self, scene_object: SceneObject) -> int:
        extras = {
            "object_id": scene_object.object_id,
            "category": scene_object.category,
            "size": list(scene_object.size),
        }
        node = {"name": scene_object.object_id, "extras": extras}
        index = self._add_cloud_node(scene_object.cloud, node)
        self._move(index, scene_object.trajectory)
        return index

    def _add_ego(self, scene: Scene) -> int:
        cameras = [self._add_camera(camera) for camera in scene.rig]
        node: dict[str, Any] = {"name": "ego", "extras": {"size": list(scene.ego_size)}}
        index = self._add_node(node | ({"children": cameras} if cameras else {}))
        self._move(index, scene.ego)
        return index

    def _add_camera(self, camera: Camera) -> int:
        lens = {
            "type": "perspective",
            "perspective": {
                "aspectRatio": camera.width * camera.K[1, 1] / (camera.height * camera.K[0, 0]),
                "yfov": 2 * float(np.arctan(camera.height / 2 / camera.K[1, 1])),
                "znear": NEAR_PLANE,
                "zfar": FAR_PLANE,
            },
        }
        self.cameras.append(lens)
        extras = {"K": camera.K.tolist(), "width": camera.width, "height": camera.height}
        node = {"name": camera.name, "camera": len(self.cameras) - 1, "extras": extras}
        return self._add_node(node | _pose(camera.T_vehicle_camera @ T_OPTICAL_GLTF))

    def _move(self, index: int, trajectory: Trajectory) -> None:
        """Place a node at ``t_us``, or at its first pose with channels for all of them."""
        at = trajectory.start_us if self.t_us is None else self.t_us
        self.nodes[index] |= _pose(trajectory.transform(at))
        if self.t_us is not None:
            return
        if len(trajectory.times_us) > 1:
            seconds = self.writer.add(
                self._seconds(trajectory.times_us), bounds=True, vertices=False
            )
            self._add_channel(index, "translation", seconds, trajectory.positions)
            rotations = _continuous(trajectory.quaternions)[:, [1, 2, 3, 0]]
            self._add_channel(index, "rotation", seconds, rotations)
        self._hide_outside(index, trajectory)

    def _hide_outside(self, index: int, trajectory: Trajectory) -> None:
        """A scale of zero before and after the trajectory, where the drive goes on longer."""
        first, last = self._seconds(np.array([trajectory.start_us, trajectory.end_us]))
        times, scales = [first], [1.0]
        if first > 0:
            times, scales = [np.float32(0), first], [0.0, 1.0]
        if trajectory.end_us < self.end_us:
            # The last instant still shows the object, so the step comes right after it.
            times.append(np.nextafter(last, np.float32(np.inf)))
            scales.append(0.0)
        if 0.0 in scales:
            key = self.writer.add(np.array(times, np.float32), bounds=True, vertices=False)
            values = np.repeat(np.array(scales)[:, None], 3, axis=1)
            self._add_channel(index, "scale", key, values, interpolation="STEP")

    def _add_channel(
        self, node: int, path: str, key: int, values: Float, *, interpolation: str = "LINEAR"
    ) -> None:
        output = self.writer.add(values.astype(np.float32), vertices=False)
        target = {"node": node, "path": path}
        self.channels.append({"sampler": len(self.samplers), "target": target})
        self.samplers.append({"input": key, "interpolation": interpolation, "output": output})

    def _seconds(self, times_us: NDArray[np.int64]) -> NDArray[np.float32]:
        seconds = ((times_us - self.start_us) / 1e6).astype(np.float32)
        # Key times increase strictly; float32 cannot tell apart what is closer than it resolves.
        for i in np.flatnonzero(np.diff(seconds) <= 0) + 1:
            seconds[i] = np.nextafter(seconds[i - 1], np.float32(np.inf))
        return seconds


def _pose(transform: Float) -> dict[str, Any]:
    """``translation`` and ``rotation`` (xyzw) of a node."""
    quaternion = matrix_to_quaternion(transform[:3, :3])
    return {
        "translation": transform[:3, 3].tolist(),
        "rotation": quaternion[[1, 2, 3, 0]].tolist(),
    }


def _continuous(quaternions: Float) -> Float:
    """The same rotations with signs such that neighbours are less than half a turn apart."""
    dots = np.sum(quaternions[1:] * quaternions[:-1], axis=1)
    signs = np.cumprod(np.concatenate([[1.0], np.where(dots < 0, -1.0, 1.0)]))
    return quaternions * signs[:, None]


def _primitive(writer: GlbWriter, cloud: GaussianCloud) -> dict[str, Any]:
    """A POINTS primitive with the extension's attributes."""

    def host(values: torch.Tensor) -> NDArray[np.float32]:
        return np.ascontiguousarray(values.detach().cpu().numpy(), dtype=np.float32)

    rgb = 0.5 + SH_C0 * host_array(cloud.sh[:, 0])
    rgba = np.concatenate([rgb, host_array(cloud.opacities)[:, None]], axis=1)
    # Clouds may be off by a thousandth; glTF asks for unit length.
    quats = torch.nn.functional.normalize(cloud.quats.double(), dim=1)
    attributes = {
        "POSITION": writer.add(host(cloud.means), bounds=True),
        "COLOR_0": writer.add(np.clip(np.rint(rgba * 255), 0, 255).astype(np.uint8)),
        f"{EXTENSION}:ROTATION": writer.add(host(quats[:, [1, 2, 3, 0]])),
        f"{EXTENSION}:SCALE": writer.add(host(cloud.scales)),
        f"{EXTENSION}:OPACITY": writer.add(host(cloud.opacities)),
    }
    for degree in range(cloud.sh_degree + 1):
        for n in range(2 * degree + 1):
            coefficients = host(cloud.sh[:, degree * degree + n])
            attributes[f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{n}"] = writer.add(coefficients)
    return {
        "mode": POINTS,
        "attributes": attributes,
        "extensions": {EXTENSION: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}},
    }
