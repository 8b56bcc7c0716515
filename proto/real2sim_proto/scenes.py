"""REST models of the worker, its scenes, single renders and the asset library."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, WithJsonSchema, model_validator

from .base import Guided, Identifier, Model, Named, Track
from .operations import SetGait, SetPhysics, SetVelocity
from .sensors import OpticsSpec

WITHOUT_SCENES = "`real2sim serve --demo` shows a street at once; your own: `real2sim reconstruct`"
"""Hint for a worker without scenes."""


class Reply(Guided, BaseModel):
    """Base of replies. Readers ignore unknown members, so that newer workers can add some."""

    model_config = ConfigDict(extra="ignore", frozen=True)


class SceneState(StrEnum):
    """Loading state of a scene."""

    AVAILABLE = "available"
    LOADING = "loading"
    RESIDENT = "resident"
    BROKEN = "broken"


class CameraInfo(Reply):
    """A camera of the recording vehicle."""

    _instead: ClassVar = {
        "extrinsics": "camera.T_vehicle_camera",
        "intrinsics": "camera.K",
        "matrix": "camera.K",
        "pose": "camera.T_vehicle_camera",
        "resolution": "camera.width and camera.height",
    }

    name: str
    width: int
    height: int
    K: list[list[float]] = Field(description="3x3 intrinsics [px]")
    T_vehicle_camera: list[list[float]] = Field(description="4x4")
    recorded: OpticsSpec | None = Field(
        default=None,
        description="lens and shutter of the log's camera, for `optics` of sensors; null: unknown",
    )


class ObjectInfo(Reply):
    """A movable object of a scene or a scenario."""

    _instead: ClassVar = {
        "corners": "client.scenarios.create(scene).objects[...].corners(t)",
        "id": "object.object_id",
        "name": "object.object_id",
        "pose": "client.scenarios.create(scene).objects[...].pose(t)",
        "position": "object.trajectory.positions[0]",
    }

    object_id: str
    category: str
    size: tuple[float, float, float] = Field(description="length, width, height [m]")
    instance_id: int = Field(description="its pixel value in instance images")
    gaussians: int
    start_us: int
    end_us: int
    trajectory: Track | None = Field(default=None, description="T_world_object; single views only")
    recorded_id: str | None = Field(
        default=None, description="object of the scene whose appearance it has"
    )
    asset_id: str | None = Field(default=None, description="asset whose appearance it has instead")
    physics: SetPhysics | None = Field(default=None, description="physics properties set by edits")
    velocity: SetVelocity | None = Field(
        default=None, description="velocity at the start of a simulation"
    )
    gait: SetGait | None = Field(default=None, description="gait of a person set by an edit")


class SceneInfo(Reply):
    """One available scene, resident or not."""

    _instead: ClassVar = {
        "duration": "(scene.end_us - scene.start_us) / 1e6 (seconds)",
        "ego_pose": "scene.ego.positions and scene.ego.quaternions",
        "edit": "client.scenarios.create(scene)",
        "id": "scene.scene",
        "lanes": "client.scenes.lanes(scene)",
        "name": "scene.scene",
        "render": "client.scenes.render(scene, camera='front')",
        "sensors": "scene.cameras",
        "session": "client.session(scene=scene)",
        "timestamps": "scene.frame_times_us",
    }

    scene: str = Field(description="name to use in paths")
    state: SceneState
    reason: str | None = Field(default=None, description="reason if the scene is broken")
    content_hash: str = ""
    gaussians: int = 0
    bytes: int = Field(default=0, description="memory use when resident")
    start_us: int = 0
    end_us: int = 0
    frame_times_us: list[int] = Field(default_factory=list)
    cameras: Named[CameraInfo] = Field(default_factory=Named)
    objects: Named[ObjectInfo] = Field(default_factory=Named)
    extent_min: tuple[float, float, float] | None = Field(default=None, description="[m], world")
    extent_max: tuple[float, float, float] | None = None
    ego: Track | None = Field(default=None, description="T_world_vehicle of the recording")
    provenance: dict[str, Any] = Field(default_factory=dict)
    has_uncertainties: bool = Field(
        default=False, description="whether the modality `uncertainty` is available"
    )
    lane_count: int = Field(
        default=0, description="number of lanes, see `GET /v1/scenes/{scene}/lanes`"
    )


class SceneList(Reply):
    """All scenes in the worker's scene folder."""

    scenes: list[SceneInfo]


class SceneImport(BaseModel):
    """Body of `POST /v1/scenes`: a bundle or splat file in the worker's import folder, or the
    included demo street."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    path: str | None = Field(
        default=None, min_length=1, max_length=4096, description="relative to the import folder"
    )
    demo: bool = Field(default=False, description="add the demo street; without a path")
    scene: str | None = Field(
        default=None, description="name to give it; default: the file's name, or `demo_street`"
    )

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        if self.demo == (self.path is not None):
            raise ValueError('give either a path below the import folder or "demo": true')
        return self


class Limits(Reply):
    """Limits of a worker."""

    max_sessions: int
    max_request_bytes: int
    max_message_bytes: int
    max_operations_per_request: int
    max_cameras_per_step: int
    max_pixels_per_step: int
    max_rays_per_step: int = Field(default=0, description="0: a worker without LiDARs")
    max_steps_per_request: int
    scene_memory_bytes: int
    queue_length: int


class DeviceInfo(Reply):
    """Device that stores and renders scenes."""

    backend: str
    reason: str = Field(description="reason for this backend")
    device: str
    threads: int


class ServerInfo(Reply):
    """Answer of `GET /v1/server`."""

    version: str
    protocol_version: int
    subprotocols: list[str]
    worker_id: str
    device: DeviceInfo
    limits: Limits
    codecs: list[str]
    modalities: list[str]
    lidar_models: list[str] = Field(
        default_factory=list, description="LiDAR models available for `lidars` of a session"
    )
    radar_models: list[str] = Field(
        default_factory=list, description="radar models available for `radars` of a session"
    )
    conventions: dict[str, str]


class FleetMember(Reply):
    """A worker of a fleet with a shared store, with its last reported status."""

    worker_id: str
    alive: bool = Field(
        description="whether its lease is valid; if not, other workers may take its sessions"
    )
    ready: bool = False
    draining: bool = False
    version: str = ""
    backend: str = ""
    sessions: int = Field(default=0, description="open sessions in its memory")
    max_sessions: int = 0
    scenes: list[str] = Field(default_factory=list, description="scenes in its memory")
    scene_sessions: dict[str, int] = Field(
        default_factory=dict, description="open sessions in its memory, by scene"
    )
    load: float = Field(
        default=0.0,
        ge=0,
        description="fraction of time that its engine was busy since its last report",
    )
    queue: int = Field(default=0, description="calls waiting for its engine")


class Fleet(Reply):
    """Answer of `GET /v1/fleet`: the workers that share the store, by name."""

    workers: list[FleetMember]


class Readiness(Reply):
    """Answer of `GET /readyz`; status 503 while `ready` is false."""

    ready: bool
    reasons: list[str] = Field(default_factory=list)


# The asset library: objects to insert into scenarios.

UpAxis = Literal["z", "y", "-y"]

Category = Annotated[str, Field(pattern=r"^[A-Za-z0-9_\-]{1,40}$")]


class AssetCut(Model):
    """Body of `POST /v1/assets` as JSON: an object cut out of a scene."""

    scene: Identifier
    object_id: Identifier
    asset_id: Identifier | None = Field(default=None, description="default: the object's id")
    category: Category | None = Field(default=None, description="default: the object's")


Build = Literal[
    "woman", "man", "short_woman", "tall_woman", "tall_man", "slim_woman", "slim_man",
    "heavy_woman", "heavy_man", "strong_man", "old_woman", "old_man",
    "girl", "boy", "small_girl", "small_boy",
]  # fmt: skip
_NUMBERS: dict[str, Any] = {"type": "array", "minItems": 3, "maxItems": 3}
Triple = Annotated[
    tuple[float, float, float], WithJsonSchema(_NUMBERS | {"items": {"type": "number"}})
]
"""Described as a list of fixed length, because some validators do not support tuples."""
Share = Annotated[float, Field(ge=0, le=1)]
Colour = Annotated[
    tuple[Share, Share, Share],
    WithJsonSchema(_NUMBERS | {"items": {"type": "number", "minimum": 0, "maximum": 1}}),
]


class AssetPerson(Model):
    """JSON body of `POST /v1/assets`: a person that walks along any trajectory."""

    asset_id: Identifier
    build: Build
    height: float | None = Field(
        default=None,
        gt=0.4,
        lt=2.6,
        description="height of the person [m]; default: from the build",
    )
    clothes: dict[
        Literal["skin", "hair", "top", "trousers", "shoes"],
        Colour,
    ] = Field(default_factory=dict, description="colours by garment, RGB in [0, 1]")
    worn: list[Literal["long_hair", "skirt"]] = Field(default_factory=list, max_length=2)


class AssetUpload(Model):
    """Form fields of `POST /v1/assets`, in addition to the part `file`."""

    asset_id: Identifier | None = Field(default=None, description="default: the file's name")
    category: Category = "car"
    up_axis: UpAxis | None = Field(
        default=None,
        description=(
            "up axis of the file; default: as stated by the file (y for spz; the header of "
            "an exported ply), otherwise z"
        ),
    )
    yaw: float = Field(
        default=0.0,
        ge=-6.3,
        le=6.3,
        description="rotation about z after that [rad], to point the front along x",
    )
    length: float | None = Field(
        default=None, gt=0, le=100, description="length along x [m]; default: by category"
    )


class AssetInfo(Reply):
    """An asset: Gaussians in a frame with x forward, z up, origin at the box centre."""

    asset_id: str
    category: str
    size: Triple = Field(description="length, width, height [m]")
    gaussians: int
    bytes: int
    content_hash: str
    ambient: Triple | None = Field(
        default=None, description="mean ambient colour of its source; None: unknown"
    )
    provenance: dict[str, Any] = Field(default_factory=dict)


class AssetList(Reply):
    """The asset library, in the order of ids."""

    assets: list[AssetInfo]
