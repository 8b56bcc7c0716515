"""The trainable scene: Gaussians, object poses and exposures, rendered for any logged view."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...geometry import (
    Float,
    multiply_quaternions,
    quaternion_to_matrix,
    transform_from,
    yaw_quaternion,
)
from ...render import Instance, RasterOptions, RenderOutput, rasterize
from ...render.backend import Backend, device_of
from ...render.select import select_backend
from ...scene import Camera, GaussianCloud, Scene, Sky, TimeColour, Trajectory
from . import gaussians as packing
from .gaussians import Gaussians
from .losses import second_differences
from .schedule import TrainOptions

# Exposure of single images.


class ImageGains:
    """Colour gains of every training image.

    Attributes:
        logarithms: [cameras * K, 3] natural logarithms of the gains of red, green and blue,
            initially 0; camera by camera, in time order.

    Args:
        cameras: number of cameras.
        times_us: [K] int64 times of training images, increasing.
        device: device of the gains.
    """

    def __init__(
        self, cameras: int, times_us: NDArray[np.int64], *, device: torch.device | str = "cpu"
    ) -> None:
        self._times_us = times_us
        rows = cameras * len(times_us)
        self.logarithms = torch.zeros(rows, 3, device=device, requires_grad=True)

    def at(self, camera: int, t_us: int) -> Tensor:
        """Gains [3] of a camera at a time, interpolated between images, with gradients."""
        times, count = self._times_us, len(self._times_us)
        after = min(int(np.searchsorted(times, t_us)), count - 1)
        before = after if times[after] <= t_us else max(after - 1, 0)
        span = max(int(times[after] - times[before]), 1)
        share = min(max((t_us - int(times[before])) / span, 0.0), 1.0) if after > before else 0.0
        held = self.logarithms[camera * count : (camera + 1) * count]
        return (held[before] * (1 - share) + held[after] * share).exp()

    def squares(self) -> Tensor:
        """Sum over an image's gains of squared logarithms, mean over all images."""
        return self.logarithms.square().sum() / max(len(self.logarithms), 1)


# Refined object poses: small corrections of the tracked boxes at the training frames.


@dataclass(frozen=True, eq=False)
class KeyPoses:
    """Corrections of one object, about its own axes.

    Attributes:
        times_us: [T] int64 key times [us].
        positions, quaternions: [T, 3] and [T, 4] float64 of the input boxes.
        first_row: first row of this object in the packed corrections.
    """

    times_us: NDArray[np.int64]
    positions: Float
    quaternions: Float
    first_row: int

    @property
    def rows(self) -> slice:
        """Rows of the packed corrections."""
        return slice(self.first_row, self.first_row + len(self.times_us))

    def covers(self, t_us: int) -> bool:
        """Whether the object exists at ``t_us``."""
        return bool(self.times_us[0] <= t_us <= self.times_us[-1])

    def bracket(self, t_us: int) -> tuple[int, int, float]:
        """Keys before and after ``t_us`` and the interpolation fraction between them."""
        after = int(np.searchsorted(self.times_us, t_us, side="left"))
        if self.times_us[after] == t_us:
            return after, after, 0.0
        before = after - 1
        span = float(self.times_us[after] - self.times_us[before])
        return before, after, float(t_us - self.times_us[before]) / span


class ObjectPoses:
    """Poses of all objects with their corrections.

    At a key time ``T_world_object = T_given [Rz(yaw) Ry(pitch) Rx(roll) | shift]``. In between,
    positions and corrections are linear and rotations slerped, as in Trajectory. Roll and pitch are
    needed because boxes are mostly labelled upright, while roads are steep and vehicles pitch when
    they brake. Objects that stand still have none: moving their Gaussians has the same effect.

    Args:
        scene: its trajectories are the initial poses.
        key_times_us: [K] times of training frames. Images correct a pose only at these times;
            other times between the first and last pose of a track are interpolated from their
            neighbours. None keeps every pose of the trajectories.
        device: device of corrections and poses.
    """

    def __init__(
        self,
        scene: Scene,
        key_times_us: NDArray[np.int64] | None,
        *,
        device: torch.device | str = "cpu",
    ) -> None:
        self.keys: list[KeyPoses] = []
        self._given: list[Trajectory] = []
        levers: list[tuple[float, float, float]] = []
        moving: list[bool] = []
        for item in scene.objects.values():
            given = item.trajectory
            if key_times_us is not None:
                given = given.sampled(key_times_us)
            key = KeyPoses(given.times_us, given.positions, given.quaternions, len(levers))
            self.keys.append(key)
            self._given.append(given)
            length, width, _ = item.size
            levers += [(width / 2, length / 2, length / 2)] * len(given.times_us)
            moving += [given.extent > 0] * len(given.times_us)
        rows = len(levers)
        self.shifts = torch.zeros(rows, 3, device=device, requires_grad=True)
        self.yaws = torch.zeros(rows, 1, device=device, requires_grad=True)
        self.tilts = torch.zeros(rows, 2, device=device, requires_grad=True)
        self._levers = torch.tensor(levers, device=device).reshape(-1, 3)
        self._moving = torch.tensor(moving, dtype=torch.float32, device=device)[:, None]

    def _applied(self) -> tuple[Tensor, Tensor]:
        """Shifts [R, 3] and roll, pitch and yaw [R, 3]; 0 for objects that stand still."""
        angles = torch.cat([self.tilts, self.yaws], dim=1)
        return self.shifts * self._moving, angles * self._moving

    def at(self, t_us: int) -> tuple[list[int], Tensor]:
        """Indices of the K objects that exist at ``t_us``, and their ``T_world_object`` [K, 4, 4]
        float64, with gradients.
        """
        present = [index for index, key in enumerate(self.keys) if key.covers(t_us)]
        if not present:
            return [], torch.zeros(0, 4, 4, dtype=torch.float64, device=self.shifts.device)
        keys = [self.keys[index] for index in present]
        before, after, fractions = zip(*(key.bracket(t_us) for key in keys), strict=True)
        first = np.array([key.first_row for key in keys])
        device = self.shifts.device
        rows = [torch.from_numpy(first + key).to(device) for key in (before, after)]
        later = torch.tensor(fractions, dtype=torch.float64, device=device)[:, None]
        weights = (1 - later).float(), later.float()
        shift, angles = (
            held[rows[0]] * weights[0] + held[rows[1]] * weights[1] for held in self._applied()
        )
        poses = [self._given[index].pose(t_us) for index in present]
        given = transform_from(*(np.array(part) for part in zip(*poses, strict=True)))
        corrections = _corrections(shift.double(), angles.double())
        return present, torch.from_numpy(given).to(device) @ corrections

    def roughness(self) -> Tensor:
        """Mean squared second differences of all refined trajectories [m, rad] at 10 Hz."""
        terms = [
            second_differences(
                torch.cat(self._refined(key), dim=1), (key.times_us * 1e-6).astype(np.float64)
            )
            for key in self.keys
            if len(key.times_us) >= 3
        ]
        return torch.stack(terms).mean() if terms else self.shifts.sum() * 0

    def squares(self) -> Tensor:
        """Squared corrections [m^2], mean over all poses; those of angles are the squared distances
        by which they move the ends of a box.
        """
        shifts, angles = self._applied()
        moved = torch.cat([shifts, angles * self._levers], dim=1)
        return moved.square().sum(dim=1).mean()

    def _refined(self, key: KeyPoses) -> tuple[Tensor, Tensor, Tensor]:
        """World positions [T, 3] about their mean, unwrapped yaws [T, 1] and corrections of roll
        and pitch [T, 2], float32."""
        device = self.shifts.device
        rotations = quaternion_to_matrix(key.quaternions).astype(np.float32)
        turns = torch.from_numpy(rotations).to(device)
        base = torch.from_numpy(key.positions - key.positions.mean(0)).float().to(device)
        shifts, angles = (held[key.rows] for held in self._applied())
        positions = base + torch.einsum("tij,tj->ti", turns, shifts)
        heading = np.unwrap(np.arctan2(rotations[:, 1, 0], rotations[:, 0, 0]))
        given = torch.from_numpy(heading.astype(np.float32)).to(device)
        return positions, given[:, None] + angles[:, 2:], angles[:, :2]

    def trajectory(self, index: int) -> Trajectory:
        """The refined trajectory of object ``index``."""
        key = self.keys[index]
        shift, angles = (held.detach()[key.rows].cpu().double().numpy() for held in self._applied())
        roll, pitch, yaw = angles.T
        rotations = quaternion_to_matrix(key.quaternions)
        positions = key.positions + np.einsum("tij,tj->ti", rotations, shift)
        quaternions = multiply_quaternions(key.quaternions, yaw_quaternion(yaw))
        for axis, angle in ((1, pitch), (0, roll)):
            quaternions = multiply_quaternions(quaternions, _about(axis, angle))
        return Trajectory(key.times_us, positions, quaternions)


def _corrections(shift: Tensor, angles: Tensor) -> Tensor:
    """``[Rz(yaw) Ry(pitch) Rx(roll) | shift]`` [K, 4, 4] of shifts [K, 3] and of roll, pitch and
    yaw [K, 3]."""
    (cr, cp, cy), (sr, sp, sy) = angles.cos().unbind(1), angles.sin().unbind(1)
    x, y, z = shift.unbind(1)
    zero, one = torch.zeros_like(x), torch.ones_like(x)
    rows = (
        (cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr, x),
        (sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr, y),
        (-sp, cp * sr, cp * cr, z),
        (zero, zero, zero, one),
    )
    return torch.stack([value for row in rows for value in row], dim=1).reshape(-1, 4, 4)


def _about(axis: int, angle: NDArray[np.float64]) -> NDArray[np.float64]:
    """Quaternions [T, 4] wxyz of rotations by ``angle`` [T] about one axis."""
    quaternions = np.zeros((len(angle), 4))
    quaternions[:, 0], quaternions[:, 1 + axis] = np.cos(angle / 2), np.sin(angle / 2)
    return quaternions


# The model: all trainable parameters, rendered for any logged view.

SYMMETRIC_CATEGORIES = ("car", "truck", "van", "bus")
"""Categories with two similar sides."""


@dataclass(frozen=True, eq=False)
class RenderedView:
    """A rendered view of the model.

    Attributes:
        output: images of one camera, with gradients.
        rgb: [H, W, 3], with the camera's exposure.
        drawn: indices of the rendered trained instances: 0 for the background, then 1 + object;
            instances of priors follow.
    """

    output: RenderOutput
    rgb: Tensor
    drawn: tuple[int, ...]


class SceneModel:
    """Trainable parameters of a scene.

    Attributes:
        device: device of the parameters and the renderer, so that no step moves them.
        mirrored: per object, whether training sometimes shows its mirrored side.
        priors: Gaussians that are rendered but not trained, or None.

    Args:
        scene: scene of stage 0; its cameras, ego path, boxes and times do not change.
        options: training options.
        key_times_us: [K] int64, times of training images, at which boxes can be refined.
        backend: backend of the renderer.
    """

    def __init__(
        self,
        scene: Scene,
        options: TrainOptions,
        key_times_us: np.ndarray,
        *,
        backend: str | Backend = "auto",
    ) -> None:
        self.scene = scene
        self.options = options
        self.backend = select_backend(backend) if isinstance(backend, str) else backend
        self.device = device_of(self.backend)
        self.gaussians = packing.from_scene(
            scene,
            sh_degree=options.sh_degree,
            harmonics=options.harmonics,
            initial_opacity=options.initial_opacity,
            device=self.device,
        )
        self.priors: Gaussians | None = None
        refined = key_times_us if options.refine_poses else None
        self.poses = ObjectPoses(scene, refined, device=self.device)
        self.sky = packing.leaf(_sky_faces(scene.sky, options.sky_resolution), self.device)
        cameras = len(scene.rig)
        self.exposure = packing.leaf(torch.eye(3, 4).expand(cameras, 3, 4), self.device)
        self.gains = ImageGains(cameras, key_times_us, device=self.device)
        self.cameras = torch.zeros(cameras, 6, device=self.device, requires_grad=True)
        vehicles = [o.category in SYMMETRIC_CATEGORIES for o in scene.objects.values()]
        self.mirrored = tuple(options.mirror > 0 and vehicle for vehicle in vehicles)
        half = [np.array(o.size) / 2 for o in scene.objects.values()]
        self.half_sizes = torch.from_numpy(np.array(half).reshape(-1, 3)).float().to(self.device)

    def stop_mirroring(self) -> None:
        """Stop using images of vehicles as evidence for their mirrored sides."""
        self.mirrored = tuple(False for _ in self.mirrored)

    def parameters(self) -> dict[str, Tensor]:
        """Every trainable tensor by name."""
        return {
            **self.gaussians.tensors(),
            "sky": self.sky,
            "pose_translation": self.poses.shifts,
            "pose_yaw": self.poses.yaws,
            "pose_tilt": self.poses.tilts,
            "exposure": self.exposure,
            "image_exposure": self.gains.logarithms,
            "camera": self.cameras,
        }

    def load(self, tensors: Mapping[str, Tensor], counts: tuple[int, ...]) -> None:
        """Load parameters returned by :meth:`parameters`."""
        fields = {name: packing.leaf(tensors[name], self.device) for name in packing.FIELDS}
        self.gaussians = Gaussians(**fields, counts=counts)
        self.sky = packing.leaf(tensors["sky"], self.device)
        self.poses.shifts = packing.leaf(tensors["pose_translation"], self.device)
        self.poses.yaws = packing.leaf(tensors["pose_yaw"], self.device)
        self.poses.tilts = packing.leaf(tensors["pose_tilt"], self.device)
        self.exposure = packing.leaf(tensors["exposure"], self.device)
        if "image_exposure" in tensors:
            self.gains.logarithms = packing.leaf(tensors["image_exposure"], self.device)
        self.cameras = packing.leaf(tensors["camera"], self.device)

    def render(
        self,
        camera: Camera,
        t_us: int,
        *,
        degree: int | None = None,
        mirrored: tuple[bool, ...] = (),
        depth: bool = False,
    ) -> RenderedView:
        """Render ``camera``, of the rig at any size, on the recording vehicle at ``t_us``.

        Args:
            degree: degree of the spherical harmonics; the highest by default.
            mirrored: per object, whether to show its mirrored side.
            depth: whether to render depth.
        """
        degree = self.options.sh_degree if degree is None else degree
        clouds = self.gaussians.clouds(degree=degree, tones=self._tones(t_us), mirrored=mirrored)
        instances, drawn = self.instances(clouds, t_us)
        if self.priors is not None:
            with torch.no_grad():
                behind = self.priors.clouds(degree=degree, mirrored=mirrored)
                instances += self.instances(behind, t_us)[0]
        options = RasterOptions(depth=depth, instance=False, track_screen=True)
        output = rasterize(
            instances,
            self.viewmat(camera, t_us)[None],
            camera.K[None],
            camera.width,
            camera.height,
            sky=Sky(self.sky),
            options=options,
            backend=self.backend,
            check_values=False,
        )
        return RenderedView(output, self.exposed(output.rgb[0], camera, t_us), tuple(drawn))

    def exposed(self, rgb: Tensor, camera: Camera, t_us: int) -> Tensor:
        """Apply the learnt exposure of a camera at a time to colours."""
        index, rates = self.scene.rig.names.index(camera.name), self.options.learning_rates
        if rates.exposure > 0:
            affine = self.exposure[index]
            rgb = rgb @ affine[:, :3].T + affine[:, 3]
        return rgb * self.gains.at(index, t_us) if rates.image_exposure > 0 else rgb

    def objects_alpha(self, camera: Camera, t_us: int) -> Tensor:
        """[H, W] accumulated opacity of the objects alone, with gradients."""
        clouds = self.gaussians.clouds(degree=0)
        instances, _ = self.instances(clouds, t_us)
        output = rasterize(
            instances[1:],
            self.viewmat(camera, t_us).detach()[None],
            camera.K[None],
            camera.width,
            camera.height,
            options=RasterOptions(depth=False, instance=False),
            backend=self.backend,
            check_values=False,
        )
        return output.alpha[0]

    def instances(self, clouds: list[GaussianCloud], t_us: int) -> tuple[list[Instance], list[int]]:
        """Clouds of background and objects at their poses at ``t_us``, and their indices."""
        instances, drawn = [Instance(clouds[0])], [0]
        there, poses = self.poses.at(t_us)
        for index, pose in zip(there, poses.unbind(), strict=True):
            if len(clouds[index + 1]):
                instances.append(Instance(clouds[index + 1], pose, instance_id=index + 1))
                drawn.append(index + 1)
        return instances, drawn

    def _tones(self, t_us: int) -> Tensor | None:
        count = int(self.gaussians.fourier.shape[1])
        if count == 0 or not self.scene.objects:
            return None
        empty = torch.zeros(0, count, 3)
        tones = [self._colour(i, empty).tones(t_us) for i in range(len(self.poses.keys))]
        return torch.stack(tones).to(self.device)

    def _colour(self, index: int, coefficients: Tensor) -> TimeColour:
        times = self.poses.keys[index].times_us
        start, end = int(times[0]), int(times[-1])
        return TimeColour(coefficients, self.options.harmonics_basis, start, max(end, start + 1))

    def viewmat(self, camera: Camera, t_us: int) -> Tensor:
        """``T_camera_world`` [4, 4] float64, refined where cameras are."""
        viewmat = torch.from_numpy(camera.viewmat(self.scene.ego.transform(t_us)))
        if self.options.learning_rates.camera <= 0:
            return viewmat
        change = self.cameras[self.scene.rig.names.index(camera.name)].double()
        return _small_motion(change) @ viewmat.to(self.device)

    def export(self, **provenance: Any) -> Scene:
        """The current scene with its priors, immutable, in separate memory.

        It renders like the model: bit for bit where boxes are unchanged, otherwise up to the
        rounding of their poses. For this, the model's own quaternions are normalised.
        """
        self.gaussians.normalise()
        gaussians = self.gaussians
        if self.priors is not None:
            self.priors.normalise()
            gaussians, _ = packing.concatenate(gaussians, self.priors)
        with torch.no_grad():
            clouds = gaussians.clouds(degree=self.options.sh_degree)
        clouds = [_own(cloud) for cloud in clouds]
        parts = torch.split(gaussians.fourier.detach().cpu(), list(gaussians.counts[1:]))
        objects = {}
        for index, (name, item) in enumerate(self.scene.objects.items()):
            varies = parts[index].numel() > 0
            objects[name] = replace(
                item,
                cloud=clouds[index + 1],
                trajectory=self.poses.trajectory(index),
                colour=self._colour(index, parts[index].clone()) if varies else None,
            )
        rig = replace(
            self.scene.rig,
            cameras=tuple(self._refined(camera, i) for i, camera in enumerate(self.scene.rig)),
        )
        return replace(
            self.scene,
            background=clouds[0],
            objects=objects,
            rig=rig,
            sky=Sky(self.sky.detach().cpu().clone()),
            provenance={**self.scene.provenance, "reconstruction": provenance},
            content_hash="",
        )

    def _refined(self, camera: Camera, index: int) -> Camera:
        if self.options.learning_rates.camera <= 0:
            return camera
        change = _small_motion(self.cameras[index].detach().cpu().double()).numpy()
        return replace(camera, T_vehicle_camera=camera.T_vehicle_camera @ np.linalg.inv(change))


def _own(cloud: GaussianCloud) -> GaussianCloud:
    copies = {name: tensor.detach().cpu().clone() for name, tensor in cloud.tensors().items()}
    return GaussianCloud(**copies)


def _sky_faces(sky: Sky | None, resolution: int) -> Tensor:
    if sky is None:
        return torch.full((6, resolution, resolution, 3), 0.5)
    faces = sky.faces.permute(0, 3, 1, 2)
    if resolution != sky.resolution:
        faces = torch.nn.functional.interpolate(faces, size=(resolution, resolution), mode="area")
    return faces.permute(0, 2, 3, 1).contiguous()


def _small_motion(change: Tensor) -> Tensor:
    """[4, 4] rigid motion of [6] shift [m] and rotation vector [rad]; carries gradients."""
    x, y, z = change[3:].unbind()
    zero = torch.zeros_like(x)
    skew = torch.stack(
        [torch.stack([zero, -z, y]), torch.stack([z, zero, -x]), torch.stack([-y, x, zero])]
    )
    top = torch.cat([torch.linalg.matrix_exp(skew), change[:3, None]], dim=1)
    last = torch.tensor([[0.0, 0, 0, 1]], dtype=change.dtype, device=change.device)
    return torch.cat([top, last])
