"""The JSON of scenes: models of a bundle's ``scene.json``, and lane graphs as documents.

A lane document is the same JSON in ``lanes.json``, over REST and in clients.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    SerializerFunctionWrapHandler,
    ValidationError,
    model_serializer,
)

from real2sim_proto.lanes import SceneLanes

from ..camera import GLOBAL, Camera, CameraRig, Optics, Shutter
from ..errors import BundleError, SceneError
from ..lane import Area, Lane, Road, RoadLane, Signal, StopLine
from ..lane_graph import LaneGraph
from ..lens import lens_from, lens_values
from ..sunlight import Sunlight
from ..trajectory import Trajectory

Count = Annotated[int, Field(ge=0)]
MAX_RINGS = 1024
Vector3 = tuple[float, float, float]
Vector4 = tuple[float, float, float, float]
Matrix3 = tuple[Vector3, Vector3, Vector3]
Bounds = tuple[Vector3, Vector3]
UNCERTAINTIES = "uncertainties"
"""Name of the optional tensor of a cloud or sky."""
Sha256 = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]


class _Part(BaseModel):
    """A part of ``scene.json``. Absent optional parts are omitted from the JSON."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    @model_serializer(mode="wrap")
    def _without_absent_parts(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        fields = type(self).model_fields
        return {
            name: value
            for name, value in handler(self).items()
            if value is not None or fields[name].is_required()
        }


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
    """Readout of a camera; see :class:`~real2sim_server.scene.Shutter`."""

    direction: str
    readout_us: Count


class OpticsPart(_Part):
    """Optics of the physical camera; see :class:`~real2sim_server.scene.camera.Optics`."""

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
        """The optics. Raises SceneError for values that lens or shutter reject."""
        shutter = GLOBAL if self.shutter is None else Shutter(**self.shutter.model_dump())
        return Optics(np.array(self.K, dtype=np.float64), lens_from(self.lens), shutter)


class CameraPart(_Part):
    """A camera; see :class:`~real2sim_server.scene.Camera`.

    Attributes:
        lens, shutter: None for a pinhole with a global shutter.
        recorded: optics of the recorded images, None if identical to the camera's.
    """

    name: str
    width: int
    height: int
    K: Matrix3
    T_vehicle_camera: tuple[Vector4, Vector4, Vector4, Vector4]
    lens: dict[str, Any] | None = None
    shutter: ShutterPart | None = None
    recorded: OpticsPart | None = None

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
    """Size and hashes of a cloud; its values are in a tensor file."""

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
    """Time-dependent colours of a cloud; see :class:`~real2sim_server.scene.TimeColour`."""

    harmonics: Count
    basis: Literal["cosine", "real_dft"]
    start_us: int
    end_us: int
    tensors: dict[str, Sha256]


class GaitPart(_Part):
    """Walking style of a person; see :class:`~real2sim_server.body.gait.GaitStyle`."""

    stride: float
    arms: float
    lean: float
    width: float
    phase: float


class FigurePart(_Part):
    """Binding of a cloud to a body; see :class:`~real2sim_server.scene.Figure`."""

    shape: list[float]
    height: float
    middle: float
    style: GaitPart
    tensors: dict[str, Sha256]


class ObjectPart(_Part):
    """One object of a scene; its tensors are keyed by its position in the list."""

    object_id: str
    category: str
    size: Vector3
    trajectory: TrajectoryPart
    cloud: CloudPart
    colour: ColourPart | None = None
    figure: FigurePart | None = None


class ReflectorPart(_Part):
    """Gaussians that only LiDARs see, without colours, with two attributes each."""

    gaussians: Count
    tensors: dict[str, Sha256]


class ResponsePart(_Part):
    """Intensity response of a LiDAR, by ring and range."""

    elevation: Annotated[list[float], Field(max_length=MAX_RINGS)]
    gain: Annotated[list[list[float]], Field(max_length=MAX_RINGS)]
    offset: Annotated[list[list[float]], Field(max_length=MAX_RINGS)]


class LidarPart(_Part):
    """The second set of a scene; its objects' tensors are keyed by their position here."""

    background: ReflectorPart
    objects: dict[str, ReflectorPart]
    incidence: Annotated[float, Field(ge=0, le=1)] = 1.0
    response: ResponsePart | None


class LanesPart(_Part):
    """Lanes of a scene. ``document`` is the content of ``lanes.json`` with lengths in place of
    arrays, which are concatenated in the tensor file.
    """

    points: Count
    values: Count
    tensors: dict[str, Sha256]
    document: dict[str, Any]


class SunlightPart(_Part):
    """The sun of a drive; see :class:`~real2sim_server.scene.Sunlight`."""

    towards: Vector3
    shade: Vector3

    @classmethod
    def of(cls, sunlight: Sunlight | None) -> SunlightPart | None:
        """The part of a scene's sunlight; None for none."""
        if sunlight is None:
            return None
        # Values come from a validated sun.
        return cls.model_construct(
            towards=tuple(sunlight.towards.tolist()), shade=tuple(sunlight.shade.tolist())
        )

    def build(self) -> Sunlight:
        """The sunlight. Raises SceneError like its constructor."""
        return Sunlight(np.array(self.towards), np.array(self.shade))


class SceneContent(_Part):
    """The content of a scene, input of the content hash."""

    cameras: list[CameraPart]
    ego: EgoPart
    frame_times_us: list[int]
    background: CloudPart
    objects: list[ObjectPart]
    sky: SkyPart | None
    ground: GroundPart
    lidar: LidarPart | None = None
    lanes: LanesPart | None = None
    sunlight: SunlightPart | None = None

    def build_rig(self) -> CameraRig:
        """The camera rig. Raises SceneError like its constructor."""
        return CameraRig(tuple(c.build() for c in self.cameras))


class AssetContent(_Part):
    """The content of an asset, input of the content hash."""

    category: str
    size: Vector3
    cloud: CloudPart
    figure: FigurePart | None = None


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


# Lane graphs as documents.

_TABLES = {
    "lanes": Lane,
    "areas": Area,
    "stop_lines": StopLine,
    "signals": Signal,
    "roads": Road,
}
_HEAD = ("source", "accuracy", "geo_reference")
_ARRAYS = {
    **dict.fromkeys(("centre", "outline", "points"), "points"),
    **dict.fromkeys(("widths", "s", "headings", "rolls", "inner", "outer"), "values"),
}
MAX_LANES_BYTES = 512 << 20


def lane_document(graph: LaneGraph, *, with_roads: bool = True) -> SceneLanes:
    """The document of a graph.

    Args:
        graph: graph of a scene.
        with_roads: include the reference lines of roads.
    """
    tables = [name for name in _TABLES if with_roads or name != "roads"]
    parts = {name: [_values(p) for p in getattr(graph, name).values()] for name in tables}
    # Values come from a validated graph; only the models define their meaning.
    return SceneLanes.model_validate({key: getattr(graph, key) for key in _HEAD} | parts)


def graph_of(document: SceneLanes) -> LaneGraph:
    """The graph of a document.

    Raises:
        SceneError: well-formed but not a valid graph; the message names the part.
    """
    tables = {
        name: [_part(kind, entry.model_dump()) for entry in getattr(document, name)]
        for name, kind in _TABLES.items()
    }
    return LaneGraph.of(**tables, **{key: getattr(document, key) for key in _HEAD})


def _values(part: Any) -> dict[str, Any]:
    found = {}
    for name in part.__dataclass_fields__:
        value = getattr(part, name)
        if isinstance(value, np.ndarray):
            value = value.tolist()
        elif isinstance(value, tuple):
            value = [_values(v) if isinstance(v, RoadLane) else v for v in value]
        found[name] = value
    return found


def _part(kind: type[Any], values: dict[str, Any]) -> Any:
    if kind is Road:
        values["lanes"] = tuple(RoadLane(**entry) for entry in values["lanes"])
    return kind(**values)


def read_lanes(path: Path) -> LaneGraph:
    """The graph in a file ``lanes.json``.

    Raises:
        BundleError: missing, too large, not a lane document, or not a valid graph; names the file.
    """
    try:
        if path.stat().st_size > MAX_LANES_BYTES:
            raise BundleError(f"{path}: is larger than {MAX_LANES_BYTES >> 20} MiB")
        return graph_of(SceneLanes.model_validate_json(path.read_bytes()))
    except OSError as error:
        raise BundleError(f"{path}: cannot be read: {error.strerror}") from error
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        place = ".".join(str(part) for part in first["loc"])
        raise BundleError(f"{path}: no document of lanes: {place}: {first['msg']}") from error
    except SceneError as error:
        raise BundleError(f"{path}: {error}") from error


def pack_lanes(graph: LaneGraph) -> tuple[dict[str, Any], dict[str, NDArray[np.float64]]]:
    """A graph as its document with lengths in place of arrays, and the arrays: ``points``
    [P, 3] and ``values`` [V], in the order of the document."""
    arrays: dict[str, list[Any]] = {"points": [], "values": []}

    def outline(value: Any, name: str = "") -> Any:
        if name in _ARRAYS:
            arrays[_ARRAYS[name]].extend(value)
            return len(value)
        if isinstance(value, dict):
            return {key: outline(entry, key) for key, entry in value.items()}
        return [outline(entry) for entry in value] if isinstance(value, list) else value

    document: dict[str, Any] = outline(lane_document(graph).model_dump(mode="json"))
    points = np.array(arrays["points"], dtype=np.float64).reshape(-1, 3)
    return document, {"points": points, "values": np.array(arrays["values"], np.float64)}


def unpack_lanes(
    document: Mapping[str, Any], arrays: Mapping[str, NDArray[np.float64]]
) -> LaneGraph:
    """Inverse of :func:`pack_lanes`.

    Raises:
        SceneError: lengths do not match the arrays, or the graph is invalid.
    """
    taken = dict.fromkeys(arrays, 0)

    def filled(value: Any, name: str = "") -> Any:
        if name in _ARRAYS:
            source = _ARRAYS[name]
            first = taken[source]
            if type(value) is not int or not 0 <= value <= len(arrays[source]) - first:
                raise SceneError(f"lanes: {name} of {value!r} entries exceeds their file")
            taken[source] += value
            return arrays[source][first : first + value].tolist()
        if isinstance(value, dict):
            return {key: filled(entry, key) for key, entry in value.items()}
        return [filled(entry) for entry in value] if isinstance(value, list) else value

    whole = filled(dict(document))
    if any(taken[name] != len(array) for name, array in arrays.items()):
        raise SceneError("lanes: their file holds more than scene.json tells of")
    try:
        return graph_of(SceneLanes.model_validate(whole))
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        raise SceneError(f"lanes: {first['loc']}: {first['msg']}") from error
