"""Messages of the drive socket, and the parts of them that REST sessions share.

Every message is a map with ``v`` (protocol version), ``type`` and ``id``. A client numbers its
messages with ``id``; the answer carries the same ``id``. The clock moves only on ``action``.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import (
    BeforeValidator,
    ConfigDict,
    Field,
    TypeAdapter,
    WithJsonSchema,
    model_validator,
)

from .base import Codec, Identifier, Metres, Microseconds, Modality, Model, Quaternion, Vector3
from .operations import Operation
from .scenarios import MAX_OPERATIONS_PER_REQUEST, EditWarning
from .scenes import CameraInfo, ObjectInfo

MAX_SENSORS = 16
MAX_PLAN_POSES = 1024


def _as_lists(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray) else value


Array = Annotated[
    Any,
    WithJsonSchema(
        {"description": "msgpack ext type 1: [dtype, shape, bytes in C order, little-endian]"}
    ),
]
"""A NumPy array on the wire."""

PlanTimes = Annotated[
    list[Microseconds], BeforeValidator(_as_lists), Field(min_length=1, max_length=MAX_PLAN_POSES)
]
PlanPose = tuple[Metres, Metres, Annotated[float, Field(ge=-1e4, le=1e4)]]
PlanPoses = Annotated[
    list[PlanPose], BeforeValidator(_as_lists), Field(min_length=1, max_length=MAX_PLAN_POSES)
]


class Envelope(Model):
    """What every message has."""

    v: Literal[1] = 1
    id: int = Field(default=0, ge=0, le=2**53)


class Told(Model):
    """Base of what a worker says. Readers ignore unknown members: newer workers may add some."""

    model_config = ConfigDict(extra="ignore")


class Answer(Envelope, Told):
    """What every message from the worker has."""


# --- shared by socket and REST sessions -------------------------------------------------------


class SensorSpec(Model):
    """One camera of an observation."""

    camera: Identifier
    modalities: list[Modality] = Field(default=["rgb"], min_length=1, max_length=3)
    width: int | None = Field(default=None, ge=16, le=8192, description="[px]; default: recorded")
    codec: Codec = Field(default="raw", description="of rgb; depth and instance are raw or png")
    quality: int = Field(default=90, ge=1, le=100, description="of jpeg")
    period_us: int | None = Field(
        default=None, gt=0, description="time between frames; a multiple of dt_us; default: dt_us"
    )

    @model_validator(mode="after")
    def _modalities_differ(self) -> SensorSpec:
        if len(set(self.modalities)) != len(self.modalities):
            raise ValueError(f"modalities {self.modalities!r} repeat one")
        return self


class EgoSpec(Model):
    """How the controlled vehicle moves."""

    dynamics: Literal["kinematic_bicycle"] = "kinematic_bicycle"
    wheelbase: Annotated[float, Field(ge=0.5, le=20)] = Field(default=2.8, description="[m]")
    max_steer: Annotated[float, Field(gt=0, le=1.4)] = Field(default=0.6, description="[rad]")
    max_steer_rate: Annotated[float, Field(gt=0, le=10)] = Field(default=0.8, description="[rad/s]")
    max_acceleration: Annotated[float, Field(gt=0, le=50)] = Field(
        default=4.0, description="[m/s^2]"
    )
    max_braking: Annotated[float, Field(gt=0, le=50)] = Field(default=8.0, description="[m/s^2]")
    max_speed: Annotated[float, Field(gt=0, le=150)] = Field(default=60.0, description="[m/s]")


class ResetSpec(Model):
    """How an episode begins and runs."""

    seed: int = Field(default=0, ge=0, lt=2**63)
    start_us: Microseconds | None = Field(default=None, description="default: start of the log")
    dt_us: int = Field(default=100_000, ge=1_000, le=1_000_000, description="clock step")
    horizon: int | None = Field(
        default=None,
        ge=1,
        le=1_000_000,
        description="steps; default and most: to the end of the log",
    )
    sensors: list[SensorSpec] = Field(default_factory=list, max_length=MAX_SENSORS)
    ego: EgoSpec = EgoSpec()
    action: Literal["trajectory", "control", "pose"] = "trajectory"
    privileged: bool = Field(default=False, description="fill `agents` of every observation")
    on_collision: Literal["terminate", "continue"] = Field(
        default="terminate", description="'continue' reports contacts and drives on unhindered"
    )


class TrajectoryPlan(Model):
    """Where the vehicle should be, tracked by the worker's controller until the next plan.

    Poses are (x, y, yaw) at ``times_us``, which increase and lie after the observation.
    """

    kind: Literal["trajectory"] = "trajectory"
    times_us: PlanTimes = Field(description="[N] int64 absolute simulation time")
    poses: PlanPoses = Field(description="[N, 3] x [m], y [m], yaw [rad]")
    frame: Literal["vehicle", "world"] = Field(
        default="vehicle", description="'vehicle': the ego frame of the observation answered"
    )

    @model_validator(mode="after")
    def _times_increase(self) -> TrajectoryPlan:
        if len(self.times_us) != len(self.poses):
            raise ValueError(f"{len(self.times_us)} times for {len(self.poses)} poses")
        if any(b <= a for a, b in zip(self.times_us, self.times_us[1:], strict=False)):
            raise ValueError("times_us must increase strictly")
        return self


class Control(Model):
    """Direct actuation for one step."""

    kind: Literal["control"] = "control"
    acceleration: Annotated[float, Field(ge=-100, le=100)] = Field(description="[m/s^2]")
    steering: Annotated[float, Field(ge=-1.6, le=1.6)] = Field(
        description="road-wheel angle [rad], positive to the left"
    )


class PoseCommand(Model):
    """Puts the vehicle there at the next time stamp, whatever its dynamics; on the ground."""

    kind: Literal["pose"] = "pose"
    x: Metres = Field(description="world [m]")
    y: Metres
    yaw: Annotated[float, Field(ge=-1e4, le=1e4)]


Plan = Annotated[TrajectoryPlan | Control | PoseCommand, Field(discriminator="kind")]
PLAN: TypeAdapter[Plan] = TypeAdapter(Plan)


class EgoState(Told):
    """The controlled vehicle at one instant; frames as in `conventions`."""

    position: Vector3
    quaternion: Quaternion
    yaw: float = Field(description="heading in the world [rad]")
    speed: float = Field(description="along vehicle x [m/s]")
    acceleration: float = Field(description="along vehicle x [m/s^2]")
    steering: float = Field(description="road-wheel angle [rad]")
    yaw_rate: float = Field(description="[rad/s]")
    size: Vector3 = Field(description="box length, width, height [m]")


class AgentState(Told):
    """Another road user at one instant."""

    object_id: str
    category: str
    position: Vector3 = Field(description="box centre, world [m]")
    quaternion: Quaternion
    velocity: Vector3 = Field(description="world [m/s]")
    size: Vector3


class Event(Told):
    """Something that happened in this step."""

    type: Literal["collision", "left_log", "horizon", "edited"]
    t_us: Microseconds
    object_id: str | None = None
    data: dict[str, float] = Field(default_factory=dict)


# --- client to server -------------------------------------------------------------------------


class Hello(Envelope):
    """First message on the socket."""

    type: Literal["hello"] = "hello"
    protocols: list[str] = Field(min_length=1, max_length=16)
    sdk: str = Field(default="", max_length=100, description="name and version of the client")
    role: Literal["controller", "observer"] = "controller"
    token: str | None = Field(default=None, max_length=500)


class Reset(Envelope):
    """Starts an episode; answered by obs(0)."""

    type: Literal["reset"] = "reset"
    spec: ResetSpec = ResetSpec()


class Action(Envelope):
    """Answer to obs(step); moves the clock by one dt and is answered by obs(step + 1)."""

    type: Literal["action"] = "action"
    step: int = Field(ge=0)
    plan: Plan


class Edit(Envelope):
    """Changes the session's world before the next step."""

    type: Literal["edit"] = "edit"
    base_rev: int | None = Field(default=None, description="refused when the session is elsewhere")
    operations: list[Operation] = Field(min_length=1, max_length=MAX_OPERATIONS_PER_REQUEST)


class Render(Envelope):
    """An out-of-loop view of the current instant; never moves time."""

    type: Literal["render"] = "render"
    sensors: list[SensorSpec] = Field(min_length=1, max_length=MAX_SENSORS)


class Bye(Envelope):
    """Ends the session; the answer is `result`."""

    type: Literal["bye"] = "bye"


ClientMessage = Annotated[Hello | Reset | Action | Edit | Render | Bye, Field(discriminator="type")]
CLIENT_MESSAGE: TypeAdapter[ClientMessage] = TypeAdapter(ClientMessage)


# --- server to client -------------------------------------------------------------------------


class Frame(Told):
    """One image of one sensor."""

    sensor: str
    modality: Modality
    t_us: Microseconds
    T_world_sensor: Array = Field(description="[4, 4] float64, camera frame to world")
    K: Array = Field(description="[3, 3] float64 intrinsics [px]")
    codec: Codec
    dtype: Literal["uint8", "uint16", "float32"]
    shape: list[int] = Field(description="[H, W, 3] or [H, W]")
    data: bytes


class Welcome(Answer):
    """Answer to hello. Loading, compilation and the first render are over by now."""

    type: Literal["welcome"] = "welcome"
    protocol: str
    session_id: str
    role: Literal["controller", "observer"]
    versions: dict[str, str] = Field(description="server, scene_hash")
    limits: dict[str, int]
    cameras: list[CameraInfo]
    objects: list[ObjectInfo]
    start_us: Microseconds
    end_us: Microseconds
    step: int | None = Field(description="of the running episode; None before reset")


class Obs(Answer):
    """What the vehicle perceives at one committed instant."""

    type: Literal["obs"] = "obs"
    step: int
    t_us: Microseconds
    revision: int = Field(description="of the session's edits")
    ego: EgoState
    command: Literal["straight", "left", "right"] = Field(description="from the route ahead")
    route: Array = Field(description="[R, 2] float64 x, y of the route ahead, vehicle frame [m]")
    frames: list[Frame]
    agents: list[AgentState] = Field(default_factory=list)
    events: list[Event] = Field(default_factory=list)
    metrics: dict[str, float] = Field(default_factory=dict)
    terminated: bool = False
    truncated: bool = False
    reason: str | None = None
    timing: dict[str, float] = Field(default_factory=dict, description="milliseconds by stage")


class Edited(Answer):
    """Answer to edit."""

    type: Literal["edited"] = "edited"
    revision: int
    created: list[str] = Field(default_factory=list)
    warnings: list[EditWarning] = Field(default_factory=list)


class View(Answer):
    """Answer to render."""

    type: Literal["view"] = "view"
    t_us: Microseconds
    revision: int
    frames: list[Frame]
    timing: dict[str, float] = Field(default_factory=dict)


class Progress(Answer):
    """Long work before welcome or obs is under way."""

    type: Literal["progress"] = "progress"
    phase: str
    eta_s: float | None = None


class Error(Answer):
    """A message was refused. The session goes on unless `fatal`."""

    type: Literal["error"] = "error"
    code: str
    detail: str
    hint: str | None = None
    retryable: bool = False
    fatal: bool = Field(default=False, description="the socket is closed after this")
    step: int | None = Field(default=None, description="step the session is at")


class Result(Answer):
    """The session is over."""

    type: Literal["result"] = "result"
    steps: int
    t_us: Microseconds | None
    reason: str | None
    metrics: dict[str, float]


ServerMessage = Annotated[
    Welcome | Obs | Edited | View | Progress | Error | Result, Field(discriminator="type")
]
SERVER_MESSAGE: TypeAdapter[ServerMessage] = TypeAdapter(ServerMessage)
