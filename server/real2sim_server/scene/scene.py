"""The immutable scene that all sessions share: objects with trajectories, and the sky."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import MappingProxyType
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..geometry import Float, box_corners
from .camera import CameraRig
from .cloud import GaussianCloud, TimeColour
from .coverage import Coverage
from .errors import SceneError, UnknownObjectError
from .figure import Figure
from .ground import Ground, of_bundle
from .ground_fit import fit_scene_ground
from .lane_graph import LaneGraph
from .lidar_surfaces import LidarSurfaces
from .sunlight import LightMap, Sunlight
from .trajectory import Trajectory

# Sky.


@dataclass(frozen=True, eq=False)
class Sky:
    """A cube map of the sky in world directions.

    Attributes:
        faces: [6, R, R, 3] float32 RGB in [0, 1], order +x -x +y -y +z -z. On each face the pixel
            (row, column) centre at u, v = (column + 0.5, row + 0.5) / R * 2 - 1 looks along the
            direction of :func:`face_directions`.
        uncertainties: [6, R, R] float32 in [0, 1] of the texels, as for a cloud's Gaussians; None
            if unknown.
    """

    faces: Tensor
    uncertainties: Tensor | None = None

    def __post_init__(self) -> None:
        shape = tuple(self.faces.shape)
        if (
            len(shape) != 4
            or shape[0] != 6
            or shape[1] != shape[2]
            or shape[3] != 3
            or shape[1] < 1
        ):
            raise SceneError(f"sky faces must be [6, R, R, 3], not {list(shape)}")
        if self.faces.dtype != torch.float32:
            raise SceneError(f"sky faces must be float32, not {self.faces.dtype}")
        given = self.uncertainties
        if given is not None and (given.shape != shape[:3] or given.dtype != torch.float32):
            raise SceneError(
                f"uncertainties of a sky must be {list(shape[:3])} float32, "
                f"not {list(given.shape)} {given.dtype}"
            )

    @property
    def resolution(self) -> int:
        """Edge length R of a face [px]."""
        return int(self.faces.shape[1])

    @property
    def nbytes(self) -> int:
        """Memory [bytes]."""
        return sum(t.numel() * t.element_size() for t in self.tensors().values())

    def tensors(self) -> dict[str, Tensor]:
        """The tensors by name, without absent ones."""
        known = {} if self.uncertainties is None else {"uncertainties": self.uncertainties}
        return {"faces": self.faces, **known}

    def check_values(self) -> None:
        """Check every value. Raises SceneError for non-finite values and those out of range."""
        if not bool(torch.isfinite(self.faces).all()):
            raise SceneError("sky: faces hold values that are not finite")
        given = self.uncertainties
        if given is not None and not bool(((given >= 0) & (given <= 1)).all()):
            raise SceneError("sky: uncertainties hold values outside [0, 1]")

    @classmethod
    def uniform(cls, rgb: tuple[float, float, float], *, resolution: int = 1) -> Sky:
        """One colour everywhere."""
        return cls(
            torch.tensor(rgb, dtype=torch.float32).expand(6, resolution, resolution, 3).contiguous()
        )

    def to(self, device: torch.device | str) -> Sky:
        """The sky on another device."""
        if torch.device(device) == self.faces.device:
            return self
        return Sky(**{name: tensor.to(device) for name, tensor in self.tensors().items()})

    def sample(self, directions: Tensor) -> Tensor:
        """Bilinear colour [..., 3] along world ``directions`` [..., 3] (any length, not zero)."""
        face, u, v = face_coordinates(directions)
        r = self.resolution
        column = ((u + 1) / 2 * r - 0.5).clamp(0, r - 1)
        row = ((v + 1) / 2 * r - 0.5).clamp(0, r - 1)
        c0, r0 = column.floor().long(), row.floor().long()
        c1, r1 = (c0 + 1).clamp(max=r - 1), (r0 + 1).clamp(max=r - 1)
        fc, fr = (column - c0)[..., None], (row - r0)[..., None]
        top = self.faces[face, r0, c0] * (1 - fc) + self.faces[face, r0, c1] * fc
        bottom = self.faces[face, r1, c0] * (1 - fc) + self.faces[face, r1, c1] * fc
        return top * (1 - fr) + bottom * fr


def face_coordinates(directions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Face index [...] and coordinates u (column), v (row) [...] in [-1, 1] of ``directions``.

    ±x faces: u = ∓y, v = -z; ±y faces: u = ±x, v = -z; +z face: u = -y, v = +x;
    -z face: u = -y, v = -x, each over the largest absolute component. Side faces are upright
    seen from inside.
    """
    x, y, z = directions.unbind(-1)
    ax, ay, az = x.abs(), y.abs(), z.abs()
    on_x = (ax >= ay) & (ax >= az)
    on_y = ~on_x & (ay >= az)
    face = torch.where(
        on_x,
        torch.where(x > 0, 0, 1),
        torch.where(on_y, torch.where(y > 0, 2, 3), torch.where(z > 0, 4, 5)),
    )
    major = torch.where(on_x, ax, torch.where(on_y, ay, az))
    u = torch.where(
        on_x, torch.where(x > 0, -y, y), torch.where(on_y, torch.where(y > 0, x, -x), -y)
    )
    v = torch.where(on_x | on_y, -z, torch.where(z > 0, x, -x))
    return face, u / major, v / major


def face_directions(resolution: int) -> NDArray[np.float32]:
    """Unit world directions [6, R, R, 3] float32 of all pixel centres.

    Inverse of :func:`face_coordinates`.
    """
    centre = (np.arange(resolution) + 0.5) / resolution * 2 - 1
    v, u = np.meshgrid(centre, centre, indexing="ij")
    one = np.ones_like(u)
    faces = np.stack(
        [
            np.stack([one, -u, -v], -1),
            np.stack([-one, u, -v], -1),
            np.stack([u, one, -v], -1),
            np.stack([-u, -one, -v], -1),
            np.stack([v, -u, one], -1),
            np.stack([-v, -u, -one], -1),
        ]
    )
    directions = faces / np.linalg.norm(faces, axis=-1, keepdims=True)
    return np.asarray(directions, dtype=np.float32)


MAX_OBJECTS = 65_534
"""Instance images are uint16: 0 is the background, 65535 is reserved."""


def box_size(size: Iterable[float], what: str) -> tuple[float, float, float]:
    """(length, width, height) [m] as plain floats.

    Raises:
        SceneError: ``size`` is not three positive lengths; names ``what``.
    """
    lengths = tuple(float(v) for v in size)
    if len(lengths) != 3 or not all(np.isfinite(lengths)) or min(lengths) <= 0:
        raise SceneError(f"{what}: size {lengths} must be three positive lengths")
    return lengths


@dataclass(frozen=True, eq=False)
class SceneObject:
    """A movable object: a cluster of Gaussians in its own frame, with a box and a trajectory.

    Attributes:
        object_id: unique in the scene, for example ``car_3``.
        category: class of the object, for example ``car``, ``truck``, ``pedestrian``.
        size: (length, width, height) along the object's x, y, z [m].
        cloud: Gaussians in the object frame: origin at the box centre, x forward, z up.
        trajectory: ``T_world_object`` over time; the object exists only in its range.
        colour: change of the cloud's colour over time, or None; see :meth:`cloud_at`.
        figure: figure of a walking person, with ``cloud`` in the rest pose; or None.

    Raises:
        SceneError: an invalid size, or a colour or figure with another number of Gaussians.
    """

    object_id: str
    category: str
    size: tuple[float, float, float]
    cloud: GaussianCloud
    trajectory: Trajectory
    colour: TimeColour | None = None
    figure: Figure | None = None

    def __post_init__(self) -> None:
        if self.colour is not None and len(self.colour.coefficients) != len(self.cloud):
            raise SceneError(
                f"object {self.object_id!r}: a colour of {len(self.colour.coefficients)} rows "
                f"for {len(self.cloud)} Gaussians"
            )
        if self.figure is not None:
            self.figure.check_cloud(self.cloud, f"object {self.object_id!r}")
        object.__setattr__(self, "size", box_size(self.size, f"object {self.object_id!r}"))

    def cloud_at(self, t_us: int) -> GaussianCloud:
        """The cloud at ``t_us``, with its colours and in the pose of its own trajectory; the cloud
        itself if nothing changes over time.
        """
        cloud = self.posed_at(t_us, self.trajectory)
        return cloud if self.colour is None else self.colour.at(cloud, t_us)

    def posed_at(self, t_us: int, trajectory: Trajectory) -> GaussianCloud:
        """The cloud in its pose at ``t_us`` along a trajectory, for example from an edit; the cloud
        itself, with unchanged colours, if it is rigid.
        """
        return (
            self.cloud if self.figure is None else self.figure.posed(self.cloud, trajectory, t_us)
        )

    def box_at(self, t_us: int) -> Float:
        """Corners [8, 3] [m] of the box in the world at ``t_us``; order of ``box_corners``.

        Raises:
            TimeOutOfRangeError: outside the trajectory.
        """
        return box_corners(self.trajectory.transform(t_us), self.size)

    @property
    def nbytes(self) -> int:
        """Memory of the Gaussians [bytes]."""
        parts = [part for part in (self.colour, self.figure) if part is not None]
        return self.cloud.nbytes + sum(part.nbytes for part in parts)

    def to(self, device: torch.device | str) -> SceneObject:
        """The object on another device."""
        colour = self.colour.to(device) if self.colour else None
        return replace(self, cloud=self.cloud.to(device), colour=colour)


@dataclass(frozen=True, eq=False)
class Scene:
    """A reconstructed drive. Immutable; sessions store only their differences from it.

    World frame: right-handed, x forward, y left, z up [m], recentred near the drive.

    Attributes:
        name: display name, also the last part of its folder.
        background: static Gaussians in the world frame.
        objects: by id, in a stable order; ``instance_id`` is 1 + position in that order.
        sky: cube map, or None for black.
        rig: cameras of the recording vehicle.
        ego: ``T_world_vehicle`` of the recording vehicle (rear axle centre on the ground).
        frame_times_us: [F] int64 time stamps of the recorded frames [us], increasing.
        ego_size: (length, width, height) of the recording vehicle's box [m].
        provenance: origin: source, reader, settings, versions (JSON values only).
        content_hash: SHA-256 of the bundle on disk; empty if not saved.
        stored_ground: fitted by the reconstruction, or None. Use :attr:`ground` instead.
        lidar: Gaussians for LiDARs, or None: LiDARs see the same Gaussians as cameras.
        lanes: lanes of its roads, from a map or the log, or None.
        sunlight: sun of the drive; None if unknown or under an overcast sky.
    """

    name: str
    background: GaussianCloud
    objects: Mapping[str, SceneObject]
    sky: Sky | None
    rig: CameraRig
    ego: Trajectory
    frame_times_us: NDArray[np.int64]
    ego_size: tuple[float, float, float] = (4.6, 1.85, 1.6)
    provenance: Mapping[str, Any] = field(default_factory=dict)
    content_hash: str = ""
    stored_ground: Ground | None = field(default=None, repr=False)
    lidar: LidarSurfaces | None = field(default=None, repr=False)
    lanes: LaneGraph | None = field(default=None, repr=False)
    sunlight: Sunlight | None = None

    def __post_init__(self) -> None:
        if len(self.objects) > MAX_OBJECTS:
            raise SceneError(f"{len(self.objects)} objects; instance images allow {MAX_OBJECTS}")
        for object_id, scene_object in self.objects.items():
            if object_id != scene_object.object_id:
                raise SceneError(f"object {scene_object.object_id!r} is stored under {object_id!r}")
        object.__setattr__(self, "ego_size", box_size(self.ego_size, f"ego of scene {self.name!r}"))
        times = np.array(self.frame_times_us, dtype=np.int64)
        if times.ndim != 1 or (np.diff(times) <= 0).any():
            raise SceneError("frame_times_us must be one-dimensional and increase strictly")
        object.__setattr__(self, "frame_times_us", times)
        object.__setattr__(self, "objects", MappingProxyType(dict(self.objects)))
        object.__setattr__(self, "provenance", MappingProxyType(dict(self.provenance)))

    def object(self, object_id: str) -> SceneObject:
        """The object with that id.

        Raises:
            UnknownObjectError: the id is unknown; the message lists the known ones.
        """
        try:
            return self.objects[object_id]
        except KeyError:
            known = ", ".join(self.objects) or "none"
            raise UnknownObjectError(
                f"no object {object_id!r} in scene {self.name!r}; it has: {known}"
            ) from None

    def instance_id(self, object_id: str) -> int:
        """Value of that object's pixels in instance images: 1 + its position in ``objects``."""
        self.object(object_id)
        return 1 + list(self.objects).index(object_id)

    @cached_property
    def ground(self) -> Ground:
        """The ground: stored, otherwise fitted once to Gaussians, boxes and the ego path."""
        if self.stored_ground is not None:
            return self.stored_ground
        if self.content_hash:
            return of_bundle(self.content_hash, self._fit_ground)
        return self._fit_ground()

    @cached_property
    def light_map(self) -> LightMap | None:
        """Sunlit and shaded ground; None without sunlight."""
        if self.sunlight is None:
            return None
        return LightMap.of(self.sunlight, self.background, self.ground, self.objects.values())

    def _fit_ground(self) -> Ground:
        return fit_scene_ground(self.background, self.ego, self.objects.values())

    @property
    def gaussian_count(self) -> int:
        """Gaussians of background and objects together."""
        return len(self.background) + sum(len(o.cloud) for o in self.objects.values())

    @property
    def has_uncertainties(self) -> bool:
        """Whether uncertainties are known."""
        return self.background.uncertainties is not None

    @cached_property
    def coverage(self) -> Coverage | None:
        """What images saw of the background and the objects without a figure; None if unknown."""
        if not self.has_uncertainties:
            return None
        solid = {k: o.cloud for k, o in self.objects.items() if o.figure is None}
        return Coverage(self.background, solid, self.ego)

    @property
    def nbytes(self) -> int:
        """Memory of all Gaussians, sky, stored ground, lanes and Gaussians for LiDARs [bytes]."""
        sky = self.sky.nbytes if self.sky else 0
        ground = self.stored_ground.nbytes if self.stored_ground else 0
        objects = sum(o.nbytes for o in self.objects.values())
        lidar = self.lidar.nbytes if self.lidar else 0
        lanes = self.lanes.nbytes if self.lanes else 0
        return self.background.nbytes + sky + ground + objects + lidar + lanes

    @property
    def start_us(self) -> int:
        """Start of the ego path [us]."""
        return self.ego.start_us

    @property
    def end_us(self) -> int:
        """End of the ego path [us]."""
        return self.ego.end_us

    def to(self, device: torch.device | str) -> Scene:
        """The scene on another device."""
        objects = {k: o.to(device) for k, o in self.objects.items()}
        return replace(
            self,
            background=self.background.to(device),
            objects=objects,
            sky=self.sky.to(device) if self.sky else None,
            stored_ground=self.__dict__.get("ground", self.stored_ground),
            lidar=self.lidar.to(device) if self.lidar else None,
        )
