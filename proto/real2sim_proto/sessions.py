"""REST models of sessions, which share their world with the drive socket."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from .base import Codec, Identifier, Microseconds, Modality, Model, Pose
from .drive import AgentState, EgoState, Event, check_asked
from .episode import MAX_SENSORS, ResetSpec, SensorSpec
from .operations import Operation
from .plans import Plan
from .scenarios import MAX_OPERATIONS_PER_REQUEST, EditWarning
from .scenes import Reply
from .sensors import (
    MAX_LIDARS,
    MAX_RADARS,
    CameraEffects,
    LensSpec,
    LidarSpec,
    PinholeLens,
    RadarSpec,
)

MAX_STEPS_PER_REQUEST = 1000


class SessionCreate(Model):
    """Optional body of `POST /v1/sessions?scene=` or `?scenario=`; starts the first episode."""

    reset: ResetSpec = ResetSpec()


class SessionInfo(Reply):
    """A session."""

    session_id: str = Field(description="<worker>.<random>; the first part is its worker")
    scene: str
    scenario_id: str | None = None
    ws_url: str = Field(description="address of the drive socket")
    token: str = Field(
        repr=False, description="authorises the drive socket and this session's REST calls"
    )
    owner: str = Field(default="default", description="name of the token that created it")
    created_at: str
    step: int | None = None
    t_us: Microseconds | None = None
    controller: bool = Field(default=False, description="whether a controller is connected")
    held: bool = Field(default=False, description="whether its clock is paused, see `.../clock`")
    reset: ResetSpec


class SessionList(Reply):
    """All sessions of a worker. Tokens are empty."""

    sessions: list[SessionInfo]


class SessionClock(Model):
    """Body of `PUT /v1/sessions/{id}/clock`: pause, resume or pace the clock of a driven session.

    While the clock is held, actions on the drive socket wait; none is lost or times out.
    Steps by REST and batched steps of many sessions ignore it.
    """

    state: Literal["running", "held", "ended"] = Field(
        description="`ended` ends the episode at the current step, with the reason `stopped`"
    )
    steps: int | None = Field(
        default=None,
        ge=1,
        le=MAX_STEPS_PER_REQUEST,
        description="for `held`: number of steps to run before the clock pauses",
    )
    pace: float | None = Field(
        default=None,
        ge=0.01,
        le=100.0,
        description=(
            "for `running`: largest ratio of simulated time to wall-clock time; default: no limit"
        ),
    )


class StepRequest(Model):
    """Body of `POST /v1/sessions/{id}/step`: n clock steps under one plan."""

    n: int = Field(default=1, ge=1, le=MAX_STEPS_PER_REQUEST)
    dt_us: int | None = Field(default=None, description="must equal the session's dt_us")
    plan: Plan | None = Field(
        default=None,
        description="default: the previous plan; before the first plan, the ego follows the log",
    )


class SessionEdit(Model):
    """Body of `POST /v1/sessions/{id}/operations`: edits of the running world before its next step;
    all operations apply, or none."""

    operations: list[Operation] = Field(min_length=1, max_length=MAX_OPERATIONS_PER_REQUEST)
    base_rev: int | None = Field(
        default=None, description="`revision` that they are based on; refused if it has changed"
    )


class SessionEdited(Reply):
    """Answer to edits of a running world."""

    session_id: str
    step: int = Field(description="the edits take effect before the step after this one")
    revision: int
    created: list[str] = Field(default_factory=list, description="ids of new objects")
    warnings: list[EditWarning] = Field(default_factory=list)


class SessionState(Reply):
    """Answer of step and `GET .../state`."""

    session_id: str
    step: int
    t_us: Microseconds
    revision: int
    ego: EgoState = Field(description="true state, independent of its own estimate")
    agents: list[AgentState]
    events: list[Event] = Field(
        default_factory=list, description="events since the previous step answer"
    )
    metrics: dict[str, float]
    terminated: bool
    truncated: bool
    reason: str | None = None
    lap: int = Field(
        default=0, description="number of times the ego returned to the start of the route"
    )
    drawn: dict[str, float] = Field(
        default_factory=dict,
        description="values that the seed drew for the start and for objects so far",
    )
    timing: dict[str, float] = Field(default_factory=dict)
    held: bool = Field(default=False, description="whether the clock is paused")
    plan: list[tuple[float, float, float]] = Field(
        default_factory=list,
        description="poses of the newest plan: x [m], y [m], yaw [rad] in the world; `GET` only",
    )
    planning_ms: float | None = Field(
        default=None,
        description=(
            "time from an observation to the newest plan, if a controller drives on the "
            "session's own socket; `GET` only"
        ),
    )


class SessionRender(Model):
    """Body of `POST /v1/sessions/{id}/render`."""

    sensors: list[SensorSpec] = Field(default_factory=list, max_length=MAX_SENSORS)
    lidars: list[LidarSpec] = Field(default_factory=list, max_length=MAX_LIDARS)
    radars: list[RadarSpec] = Field(default_factory=list, max_length=MAX_RADARS)

    @model_validator(mode="after")
    def _shows_something(self) -> SessionRender:
        check_asked(self.sensors, self.lidars, self.radars)
        return self


# Pictures of a scene from any pose: `POST /v1/scenes/{scene}/render`.

MAX_POSED = 4096

MIN_FOCAL = 0.1
"""Minimum focal length [px]."""

Pixels = Annotated[float, Field(ge=-1e6, le=1e6)]
Row = tuple[Pixels, Pixels, Pixels]


def _intrinsics(K: tuple[Row, Row, Row]) -> tuple[Row, Row, Row]:
    (fx, skew, _), (below, fy, _), last = K
    if min(fx, fy) < MIN_FOCAL or skew != 0 or below != 0 or last != (0.0, 0.0, 1.0):
        raise ValueError(
            f"K {K!r} is not that of a pinhole camera: [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], "
            f"fx and fy {MIN_FOCAL} pixels or more"
        )
    return K


class FreeCamera(Model):
    """A camera with an arbitrary pose in the world."""

    name: Identifier = Field(description="name of its frames")
    width: int = Field(ge=16, le=8192, description="[px]")
    height: int = Field(ge=16, le=8192, description="[px]")
    K: Annotated[tuple[Row, Row, Row], AfterValidator(_intrinsics)] = Field(
        description="3x3 intrinsics [px]; pixel centres are at +0.5"
    )
    lens: LensSpec = PinholeLens()
    pose: Pose = Field(description="T_world_camera; x right, y down, z forward")
    modalities: list[Modality] = Field(default=["rgb"], min_length=1, max_length=6)
    codec: Codec = Field(
        default="raw", description="encoding of rgb; other modalities are raw or png"
    )
    quality: int = Field(default=90, ge=1, le=100, description="JPEG quality")
    effects: CameraEffects | None = Field(
        default=None, description="camera effects on colour images; default: none"
    )


class PosedObject(Model):
    """Pose of an object in one image."""

    object_id: Identifier
    pose: Pose = Field(description="T_world_object; its origin is the box centre")


class SceneView(Model):
    """Body of `POST /v1/scenes/{scene}/render`: one instant, from any cameras."""

    t_us: Microseconds | None = Field(
        default=None, description="time of objects without a pose here; default: the start"
    )
    cameras: list[FreeCamera] = Field(min_length=1, max_length=MAX_SENSORS)
    objects: list[PosedObject] = Field(default_factory=list, max_length=MAX_POSED)
    others: Literal["recorded", "parked", "none"] = Field(
        default="recorded",
        description="objects without a pose here: as recorded at `t_us`; only parked ones; or none",
    )

    @model_validator(mode="after")
    def _names_differ(self) -> SceneView:
        for what, names in (
            ("cameras", [camera.name for camera in self.cameras]),
            ("objects", [posed.object_id for posed in self.objects]),
        ):
            if len(set(names)) != len(names):
                raise ValueError(f"{what} name one twice: {names[:8]}")
        return self


__all__ = ["FreeCamera", "PosedObject", "SceneView"]
