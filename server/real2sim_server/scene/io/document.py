"""The JSON part of a bundle: its models, and the way from and to the scene types."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, SerializerFunctionWrapHandler, model_serializer

from ..camera import Camera, CameraRig, Optics
from ..lens import lens_from, lens_values
from ..shutter import GLOBAL, Shutter
from ..trajectory import Trajectory

Count = Annotated[int, Field(ge=0)]
MAX_RINGS = 1024
Vector3 = tuple[float, float, float]
Vector4 = tuple[float, float, float, float]
Matrix3 = tuple[Vector3, Vector3, Vector3]
Bounds = tuple[Vector3, Vector3]
UNCERTAINTIES = "uncertainties"
"""Tensor that a cloud or sky may have, from version 5 on."""
Sha256 = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class TrajectoryPart(_Part):
    """Poses over time; see :class:`~real2sim_server.scene.Trajectory`."""

    times_us: list[int]
    positions: list[Vector3]
    quaternions: list[Vector4]

    @classmethod
    def of(cls, trajectory: Trajectory) -> TrajectoryPart:
        """The part that describes ``trajectory``, exact to the last bit."""
        return cls(
            times_us=trajectory.times_us.tolist(),
            positions=trajectory.positions.tolist(),
            quaternions=trajectory.quaternions.tolist(),
        )

    def build(self) -> Trajectory:
        """The trajectory. Raises SceneError like its constructor."""
        return Trajectory(
            np.array(self.times_us, dtype=np.int64),
            np.array(self.positions, dtype=np.float64),
            np.array(self.quaternions, dtype=np.float64),
        )


class ShutterPart(_Part):
    """How a camera reads out; see :class:`~real2sim_server.scene.Shutter`."""

    direction: str
    readout_us: Count


class OpticsPart(_Part):
    """What a camera really is; see :class:`~real2sim_server.scene.camera.Optics`."""

    K: Matrix3
    lens: dict[str, Any] | None = None
    shutter: ShutterPart | None = None

    @classmethod
    def of(cls, optics: Optics) -> OpticsPart:
        """The part that describes ``optics``, exact to the last bit."""
        shutter = optics.shutter
        part = ShutterPart(direction=shutter.direction, readout_us=shutter.readout_us)
        return cls(
            K=optics.K.tolist(),
            lens=lens_values(optics.lens),
            shutter=part if shutter.rolls else None,
        )

    def build(self) -> Optics:
        """The optics. Raises SceneError for values that lens or shutter refuse."""
        shutter = GLOBAL if self.shutter is None else Shutter(**self.shutter.model_dump())
        return Optics(np.array(self.K, dtype=np.float64), lens_from(self.lens), shutter)

    @model_serializer(mode="wrap")
    def _without_absent_parts(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        return {k: v for k, v in handler(self).items() if v is not None}


class CameraPart(_Part):
    """A camera; see :class:`~real2sim_server.scene.Camera`.

    Attributes:
        lens, shutter, recorded: left out of the JSON where the camera is a pinhole with a global
            shutter, and known to be nothing else, as versions 1 to 3 of the format ask.
    """

    name: str
    width: int
    height: int
    K: Matrix3
    T_vehicle_camera: tuple[Vector4, Vector4, Vector4, Vector4]
    lens: dict[str, Any] | None = None
    shutter: ShutterPart | None = None
    recorded: OpticsPart | None = None

    @model_serializer(mode="wrap")
    def _without_absent_parts(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        return {k: v for k, v in handler(self).items() if v is not None}

    @property
    def has_optics(self) -> bool:
        """Whether it says more than a pinhole needs."""
        return any(part is not None for part in (self.lens, self.shutter, self.recorded))

    @classmethod
    def of(cls, camera: Camera) -> CameraPart:
        """The part that describes ``camera``, exact to the last bit."""
        own = OpticsPart.of(Optics(camera.K, camera.lens, camera.shutter))
        return cls(
            name=camera.name,
            width=camera.width,
            height=camera.height,
            K=own.K,
            T_vehicle_camera=camera.T_vehicle_camera.tolist(),
            lens=own.lens,
            shutter=own.shutter,
            recorded=None if camera.recorded is None else OpticsPart.of(camera.recorded),
        )

    def build(self) -> Camera:
        """The camera. Raises SceneError like its constructor."""
        own = OpticsPart(K=self.K, lens=self.lens, shutter=self.shutter).build()
        return Camera(
            self.name,
            self.width,
            self.height,
            own.K,
            np.array(self.T_vehicle_camera, dtype=np.float64),
            own.lens,
            own.shutter,
            None if self.recorded is None else self.recorded.build(),
        )


class CloudPart(_Part):
    """Size and hashes of a cloud; the numbers themselves lie in a tensor file."""

    gaussians: Count
    sh_degree: Annotated[int, Field(ge=0, le=3)]
    tensors: dict[str, Sha256]


class SkyPart(_Part):
    """Size and hash of a sky."""

    resolution: Annotated[int, Field(ge=1)]
    tensors: dict[str, Sha256]


class GroundPart(_Part):
    """Grid and hashes of the ground; see :class:`~real2sim_server.scene.Ground`."""

    origin: tuple[float, float]
    cell: Annotated[float, Field(gt=0)]
    shape: tuple[Annotated[int, Field(ge=2)], Annotated[int, Field(ge=2)]]
    tensors: dict[str, Sha256]


class EgoPart(_Part):
    """The recording vehicle."""

    size: Vector3
    trajectory: TrajectoryPart


class ColourPart(_Part):
    """How the colours of a cloud change; see :class:`~real2sim_server.scene.TimeColour`."""

    harmonics: Count
    basis: Literal["cosine", "real_dft"]
    start_us: int
    end_us: int
    tensors: dict[str, Sha256]


class GaitPart(_Part):
    """How a person walks; see :class:`~real2sim_server.body.gait.GaitStyle`."""

    stride: float
    arms: float
    lean: float
    width: float
    phase: float


class FigurePart(_Part):
    """How a cloud follows a body; see :class:`~real2sim_server.scene.Figure`."""

    shape: list[float]
    height: float
    middle: float
    style: GaitPart
    tensors: dict[str, Sha256]


class ObjectPart(_Part):
    """One object of a scene; its tensors are keyed by its position in the list.

    Attributes:
        colour: left out of the JSON where there is none, as version 1 of the format asks.
        figure: left out of the JSON where there is none, as versions 1 to 6 of the format ask.
    """

    object_id: str
    category: str
    size: Vector3
    trajectory: TrajectoryPart
    cloud: CloudPart
    colour: ColourPart | None = None
    figure: FigurePart | None = None

    @model_serializer(mode="wrap")
    def _without_absent_parts(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        return _present(handler(self), "colour", "figure")


def _present(values: dict[str, Any], *names: str) -> dict[str, Any]:
    """``values`` without those of ``names`` that are None."""
    return {k: v for k, v in values.items() if v is not None or k not in names}


class ReflectorPart(_Part):
    """Gaussians that only LiDARs see, without colours, with two attributes each."""

    gaussians: Count
    tensors: dict[str, Sha256]


class ResponsePart(_Part):
    """What a LiDAR makes of reflectivity, by ring and range."""

    elevation: Annotated[list[float], Field(max_length=MAX_RINGS)]
    gain: Annotated[list[list[float]], Field(max_length=MAX_RINGS)]
    offset: Annotated[list[list[float]], Field(max_length=MAX_RINGS)]


class LidarPart(_Part):
    """The second set of a scene; its objects' tensors are keyed by their position here."""

    background: ReflectorPart
    objects: dict[str, ReflectorPart]
    incidence: Annotated[float, Field(ge=0, le=1)] = 1.0
    response: ResponsePart | None = None


class LanesPart(_Part):
    """Lanes of a scene; ``document`` is that of ``lanes.json`` with lengths in the place of its
    arrays, which lie in the tensor file one after the other.
    """

    points: Count
    values: Count
    tensors: dict[str, Sha256]
    document: dict[str, Any]


class SceneContent(_Part):
    """Everything that makes a scene what it is; the content hash is taken over this.

    Attributes:
        ground: left out of the JSON where there is none, as versions 1 and 2 of the format ask.
        lidar: left out of the JSON where there is none, as versions 1 to 4 of the format ask.
        lanes: left out of the JSON where there are none, as versions 1 to 5 of the format ask.
    """

    cameras: list[CameraPart]
    ego: EgoPart
    frame_times_us: list[int]
    background: CloudPart
    objects: list[ObjectPart]
    sky: SkyPart | None
    ground: GroundPart | None = None
    lidar: LidarPart | None = None
    lanes: LanesPart | None = None

    @model_serializer(mode="wrap")
    def _without_absent_parts(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        values: dict[str, Any] = handler(self)
        for name in ("ground", "lidar", "lanes"):
            if values.get(name) is None:
                values.pop(name, None)
        return values

    @property
    def version(self) -> int:
        """Lowest version of the format that holds this content."""
        if any(o.figure is not None for o in self.objects):
            return 7
        if self.lanes is not None:
            return 6
        stored = [self.background.tensors, *(o.cloud.tensors for o in self.objects)]
        stored += [] if self.sky is None else [self.sky.tensors]
        if self.lidar is not None or any(UNCERTAINTIES in tensors for tensors in stored):
            return 5
        if any(camera.has_optics for camera in self.cameras):
            return 4
        if self.ground is not None:
            return 3
        return 2 if any(o.colour is not None for o in self.objects) else 1

    def build_rig(self) -> CameraRig:
        """The camera rig. Raises SceneError like its constructor."""
        return CameraRig(tuple(c.build() for c in self.cameras))


class AssetContent(_Part):
    """Everything that makes an asset what it is; the content hash is taken over this.

    Attributes:
        figure: left out of the JSON where there is none, as versions 1 to 6 of the format ask.
    """

    category: str
    size: Vector3
    cloud: CloudPart
    figure: FigurePart | None = None

    @model_serializer(mode="wrap")
    def _without_absent_figure(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        return _present(handler(self), "figure")

    @property
    def version(self) -> int:
        """Lowest version of the format that holds this content."""
        if self.figure is not None:
            return 7
        return 5 if UNCERTAINTIES in self.cloud.tensors else 1


class _Document(_Part):
    format: str
    version: int
    name: str
    content_hash: Sha256
    provenance: dict[str, Any]
    files: dict[str, Count]


class SceneDocument(_Document):
    """``scene.json`` of a scene as a whole.

    Attributes:
        files: bytes of each tensor file by name.
        bounds: lowest and highest Gaussian centre of the background [m], None without any.
    """

    kind: Literal["scene"]
    bounds: Bounds | None
    content: SceneContent


class AssetDocument(_Document):
    """``scene.json`` of an asset as a whole.

    Attributes:
        files: bytes of each tensor file by name.
    """

    kind: Literal["asset"]
    content: AssetContent
