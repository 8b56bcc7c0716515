"""Messages of the drive socket, and the parts shared with REST sessions.

Every message is a map with ``v`` (protocol version), ``type`` and ``id``. A client numbers its
messages with ``id``, and the answer has the same ``id``. The clock only advances on ``action``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, ClassVar, Literal

from pydantic import ConfigDict, Field, TypeAdapter, WithJsonSchema, model_validator

from .base import (
    MAX_TOKEN,
    Codec,
    Identifier,
    Microseconds,
    Modality,
    Model,
    Named,
    Quaternion,
    Vector3,
    one_of,
)
from .episode import MAX_SENSORS, ResetSpec, SensorSpec
from .lanes import LaneKind
from .operations import Operation
from .plans import Gear, Plan, PlanPoses, PlanTimes, check_times
from .scenarios import MAX_OPERATIONS_PER_REQUEST, EditWarning
from .scenes import CameraInfo, ObjectInfo
from .sensors import (
    MAX_LIDARS,
    MAX_RADARS,
    CloudCodec,
    CloudField,
    CloudFrame,
    CloudModality,
    LidarSpec,
    RadarSpec,
)

# Shared memory for images, between a worker and a controller on the same machine.
#
# The file starts with a marker and a secret; slots of equal size follow. A client that can open the
# file and returns the secret must be on the worker's machine; an address would not prove that.

SHM_FOLDER = "/dev/shm"
"""Folder of shared memory files on POSIX systems."""
SHM_NAME = r"^real2sim-[0-9a-f]{32}$"
"""Pattern of the file names; no other file is opened or removed."""
SHM_MAGIC = b"real2sim-frames1"
SHM_SECRET_BYTES = 32
SHM_HEADER_BYTES = 4096
SHM_ALIGNMENT = 64
"""Alignment of images in bytes."""
MAX_SHM_SLOTS = 64


Array = Annotated[
    Any,
    WithJsonSchema(
        {"description": "msgpack ext type 1: [dtype, shape, bytes in C order, little-endian]"}
    ),
]
"""A NumPy array on the wire."""

Slot = Annotated[
    int | None,
    Field(
        ge=0,
        lt=MAX_SHM_SLOTS,
        description=(
            "slot of the shared memory for raw images of the answer; None, or without "
            "shared memory: images are part of the answer"
        ),
    ),
]


def check_asked(*asked: Sequence[object]) -> None:
    """Raise ValueError if there is nothing to render."""
    if not any(asked):
        raise ValueError("the request is empty; name sensors, lidars or radars")


class Envelope(Model):
    """Members of every message."""

    v: Literal[1] = 1
    id: int = Field(default=0, ge=0, le=2**53)


class ServerModel(Model):
    """Base of the worker's messages. Readers ignore unknown members: newer workers may add some."""

    model_config = ConfigDict(extra="ignore")


class ServerEnvelope(Envelope, ServerModel):
    """Members of every message from the worker."""


# --- shared by socket and REST sessions -------------------------------------------------------


class EgoState(ServerModel):
    """State of the controlled vehicle at one time; frames as in `conventions`."""

    _instead: ClassVar = {
        "heading": "ego.yaw",
        "orientation": "ego.quaternion",
        "pose": "ego.position and ego.quaternion",
        "rotation": "ego.quaternion",
        "v": "ego.speed",
        "velocity": "ego.speed (along the vehicle) and ego.lateral_speed",
        "x": "ego.position[0]",
        "y": "ego.position[1]",
        "z": "ego.position[2]",
    }

    position: Vector3
    quaternion: Quaternion
    yaw: float = Field(description="heading in the world [rad]")
    speed: float = Field(description="speed along vehicle x, negative in reverse [m/s]")
    gear: Gear = "drive"
    lateral_speed: float = Field(
        default=0.0, description="speed of the rear axle along vehicle y [m/s]"
    )
    acceleration: float = Field(description="acceleration along vehicle x [m/s^2]")
    steering: float = Field(description="road-wheel angle [rad]")
    yaw_rate: float = Field(description="[rad/s]")
    size: Vector3 = Field(description="box length, width, height [m]")


Lamp = Literal["brake", "indicator_left", "indicator_right"]


class AgentState(ServerModel):
    """Another road user at one time."""

    _instead: ClassVar = {
        "heading": "2 * math.atan2(agent.quaternion[3], agent.quaternion[0])",
        "id": "agent.object_id",
        "rotation": "agent.quaternion",
        "speed": "math.hypot(*agent.velocity)",
        "type": "agent.category",
        "x": "agent.position[0]",
        "y": "agent.position[1]",
        "yaw": "2 * math.atan2(agent.quaternion[3], agent.quaternion[0])",
    }

    object_id: str
    category: str
    position: Vector3 = Field(description="box centre, world [m]")
    quaternion: Quaternion
    velocity: Vector3 = Field(description="world [m/s]")
    size: Vector3
    lamps: list[Annotated[str, one_of(Lamp)]] = Field(
        default_factory=list, description="lit lamps at this time"
    )


EventType = Literal[
    "collision",
    "left_log",
    "off_road",
    "agents_react",
    "deadline_missed",
    "horizon",
    "edited",
    "stopped",
    "looped",
    "storyboard",
]


class Event(ServerModel):
    """An event of this step."""

    type: str = one_of(EventType)
    t_us: Microseconds
    object_id: str | None = None
    other_id: str | None = Field(
        default=None, description="the second object of a contact without the ego"
    )
    data: dict[str, float] = Field(default_factory=dict)
    element: str | None = Field(
        default=None,
        description=(
            "for 'storyboard': names from the story down to the changed element, joined by "
            "'::'; t_us is the time of the change, within 10 ms"
        ),
    )
    element_type: str | None = Field(
        default=None, description="story, act, maneuver_group, maneuver, event or action"
    )
    change: str | None = Field(default=None, description="its transition: start, end, stop or skip")


class SignalShown(ServerModel):
    """State of a traffic signal of the storyboard."""

    signal_id: str
    state: str = Field(
        description="as written in the storyboard, for example 'red' or 'off;off;on'"
    )
    stop_line: Vector3 | None = Field(
        default=None, description="x, y [m], heading [rad] of the stop line, world"
    )


class LaneShown(ServerModel):
    """A section of a lane of the scene's map, near the vehicle."""

    lane_id: str
    kind: LaneKind
    places: Array = Field(
        description=(
            "[K, 4] float64: x, y [m], heading [rad] of the centre line in driving "
            "direction, world; width [m]"
        )
    )
    speed_limit: float | None = Field(default=None, description="[m/s]; None: unknown")
    successors: list[str] = Field(default_factory=list)
    left: str | None = Field(default=None, description="neighbour in the same direction")
    right: str | None = None
    opposite: str | None = Field(default=None, description="neighbour in the opposite direction")
    may_change_left: bool = True
    may_change_right: bool = True
    junction: str | None = None


class Score(ServerModel):
    """One score of an episode, with the version of its formula.

    Scores of different versions are not comparable.
    """

    name: str
    version: str
    value: float | None = Field(description="None if undefined, see `missing`")
    terms: dict[str, float] = Field(default_factory=dict, description="its components")
    assumed: list[str] = Field(
        default_factory=list, description="assumptions made because inputs are missing"
    )
    missing: list[str] = Field(default_factory=list, description="required inputs that are missing")
    cannot_see: str = Field(
        default="",
        description=(
            "one sentence: what it cannot detect in this episode, and what of that occurred"
        ),
    )


# --- client to server -------------------------------------------------------------------------


class Resume(Model):
    """Continues a session whose connection was lost."""

    token: str = Field(
        max_length=MAX_TOKEN, repr=False, description="`resume_token` of the welcome"
    )
    last_step: int | None = Field(
        default=None, ge=0, description="step of the newest observation received"
    )


class Hello(Envelope):
    """First message on the socket."""

    type: Literal["hello"] = "hello"
    protocols: list[str] = Field(min_length=1, max_length=16)
    sdk: str = Field(default="", max_length=100, description="name and version of the client")
    role: Literal["controller", "observer", "agent"] = Field(
        default="controller", description="'agent' drives objects whose driver is 'external'"
    )
    token: str | None = Field(default=None, max_length=MAX_TOKEN, repr=False)
    resume: Resume | None = Field(default=None, description="for a controller")


class Attach(Envelope):
    """Confirms that the client has opened the shared memory; answered by attached.

    Only valid as the first message after the welcome; any other message declines it.
    """

    type: Literal["attach"] = "attach"
    secret: bytes = Field(
        min_length=SHM_SECRET_BYTES,
        max_length=SHM_SECRET_BYTES,
        description="secret read from the shared memory, which proves access to it",
    )


class Reset(Envelope):
    """Starts an episode; answered by obs(0)."""

    type: Literal["reset"] = "reset"
    spec: ResetSpec = ResetSpec()
    slot: Slot = None


class Action(Envelope):
    """Answer to obs(step); advances the clock by one dt and is answered by obs(step + 1)."""

    type: Literal["action"] = "action"
    step: int = Field(ge=0)
    plan: Plan
    slot: Slot = None


class Edit(Envelope):
    """Edits the session's world before the next step."""

    type: Literal["edit"] = "edit"
    base_rev: int | None = Field(
        default=None, description="refused if the session is at another revision"
    )
    operations: list[Operation] = Field(min_length=1, max_length=MAX_OPERATIONS_PER_REQUEST)


class Render(Envelope):
    """Requests an out-of-loop view of the current time; does not advance the clock."""

    type: Literal["render"] = "render"
    sensors: list[SensorSpec] = Field(default_factory=list, max_length=MAX_SENSORS)
    lidars: list[LidarSpec] = Field(default_factory=list, max_length=MAX_LIDARS)
    radars: list[RadarSpec] = Field(default_factory=list, max_length=MAX_RADARS)
    slot: Slot = None

    @model_validator(mode="after")
    def _shows_something(self) -> Render:
        check_asked(self.sensors, self.lidars, self.radars)
        return self


class Agent(Envelope):
    """The trajectory of an externally driven object from the next step; answered by `driven`."""

    type: Literal["agent"] = "agent"
    object_id: Identifier
    times_us: PlanTimes = Field(description="[N] int64 absolute simulation time")
    poses: PlanPoses = Field(description="[N, 3] x [m], y [m], yaw [rad] of its box, world")

    @model_validator(mode="after")
    def _times_increase(self) -> Agent:
        check_times(self.times_us, len(self.poses))
        return self


class Snapshot(Envelope):
    """Saves the current state to return to; answered by `kept`."""

    type: Literal["snapshot"] = "snapshot"
    name: Identifier


class Restore(Envelope):
    """Returns to a snapshot; answered by its obs."""

    type: Literal["restore"] = "restore"
    name: Identifier


class Fork(Envelope):
    """Creates a new session that continues from the current state; answered by `forked`."""

    type: Literal["fork"] = "fork"


class Bye(Envelope):
    """Ends the session; the answer is `result`."""

    type: Literal["bye"] = "bye"


ClientMessage = Annotated[
    Hello | Attach | Reset | Action | Edit | Render | Agent | Snapshot | Restore | Fork | Bye,
    Field(discriminator="type"),
]
CLIENT_MESSAGE: TypeAdapter[ClientMessage] = TypeAdapter(ClientMessage)


# --- server to client -------------------------------------------------------------------------


class Frame(ServerModel):
    """One image of one sensor."""

    sensor: str
    modality: Modality
    t_us: Microseconds
    T_world_sensor: Array = Field(description="[4, 4] float64, camera frame to world")
    K: Array = Field(description="[3, 3] float64 intrinsics [px]")
    codec: Codec
    dtype: Literal["uint8", "uint16", "float32"]
    shape: list[int] = Field(description="[H, W, 3] or [H, W]")
    lens: str | None = Field(default=None, description="lens model; None: pinhole")
    shutter: str | None = Field(
        default=None, description="readout direction of the shutter; None: global"
    )
    effects: list[str] | None = Field(
        default=None, description="effects of the sensor that are on; None: none"
    )
    offset: int | None = Field(
        default=None,
        ge=0,
        description="offset of a raw image in the shared memory [bytes]",
    )
    data: bytes = Field(description="empty if the image is in the shared memory")


class PointCloud(ServerModel):
    """Measurements of a LiDAR or a radar: columns, concatenated in `data`."""

    sensor: str
    modality: str = one_of(CloudModality)
    t_us: Microseconds = Field(description="time stamp; a sweep fires its last ray then")
    duration_us: int = Field(description="time from the first ray to the last; 0 for radars")
    frame: str = one_of(CloudFrame)
    compensated: bool = Field(
        description=(
            "points are compensated to the pose at `t_us`; false: each point is relative to "
            "the pose at its own ray's time"
        )
    )
    T_world_sensor: Array = Field(description="[4, 4] float64, sensor to world at `t_us`")
    T_vehicle_sensor: Array = Field(description="[4, 4] float64")
    count: int = Field(ge=0, description="number of points, N")
    fields: list[CloudField] = Field(description="columns in order; each [N, width]")
    codec: str = one_of(CloudCodec)
    data: bytes = Field(
        description=(
            "'raw': the columns, little-endian; 'deflate': the same compressed by zlib, "
            "with the bytes of each column shuffled: all first bytes, then all second "
            "bytes, and so on"
        )
    )


class SharedMemory(ServerModel):
    """Shared memory for raw images, for a controller on the worker's machine."""

    name: str = Field(pattern=SHM_NAME, description="name of a file in /dev/shm")
    slots: int = Field(ge=1, le=MAX_SHM_SLOTS)
    slot_bytes: int = Field(
        ge=1, le=2**40, description="size of each slot; the first slot begins at byte 4096"
    )


class Welcome(ServerEnvelope):
    """Answer to hello, after loading, compilation and the first render."""

    type: Literal["welcome"] = "welcome"
    protocol: str
    session_id: str
    role: Literal["controller", "observer", "agent"]
    versions: dict[str, str] = Field(description="server, scene_hash, metrics")
    limits: dict[str, int]
    cameras: Named[CameraInfo]
    objects: Named[ObjectInfo]
    route: Array | None = Field(
        default=None,
        description=(
            "[R, 4] float64 x, y, z [m], heading [rad] along the recorded drive, world, a "
            "point every metre (at most 4096); None: an older worker"
        ),
    )
    start_us: Microseconds
    end_us: Microseconds
    step: int | None = Field(description="step of the running episode; None before reset")
    revision: int = Field(default=0, description="revision of the session's edits")
    resume_token: str | None = Field(
        repr=False, default=None, description="for a controller: resumes after a lost connection"
    )
    shared_memory: SharedMemory | None = Field(
        default=None,
        description="for a controller on the same machine: shared memory to `attach`",
    )


class Attached(ServerEnvelope):
    """Answer to attach. Later messages may name slots."""

    type: Literal["attached"] = "attached"


class Obs(ServerEnvelope):
    """The vehicle's perception at one committed step."""

    type: Literal["obs"] = "obs"
    step: int
    t_us: Microseconds
    revision: int = Field(description="revision of the session's edits")
    ego: EgoState
    command: Literal["straight", "left", "right"] = Field(
        description="command derived from the route ahead"
    )
    route: Array = Field(description="[R, 2] float64 x, y of the route ahead, vehicle frame [m]")
    frames: list[Frame]
    clouds: list[PointCloud] = Field(
        default_factory=list, description="clouds of LiDARs and radars that are due"
    )
    agents: list[AgentState] = Field(default_factory=list)
    events: list[Event] = Field(default_factory=list)
    signals: list[SignalShown] = Field(
        default_factory=list, description="traffic signals of the storyboard"
    )
    lanes: list[LaneShown] = Field(
        default_factory=list,
        description=(
            "in privileged episodes on a scene with a map: lanes within 60 m, nearest "
            "first, at most 32"
        ),
    )
    metrics: dict[str, float] = Field(default_factory=dict)
    terminated: bool = False
    truncated: bool = False
    reason: str | None = None
    warming_up: bool = Field(default=False, description="the ego still moves as recorded")
    lap: int = Field(
        default=0, description="number of times the ego returned to the start of the route"
    )
    drawn: dict[str, float] = Field(
        default_factory=dict,
        description="values that the seed drew for this episode in the last step, by name",
    )
    ego_truth: EgoState | None = Field(
        default=None,
        description="true state, in a privileged episode whose `ego` is an estimate with errors",
    )
    timing: dict[str, float] = Field(default_factory=dict, description="time by stage [ms]")


class Edited(ServerEnvelope):
    """Answer to edit."""

    type: Literal["edited"] = "edited"
    revision: int
    created: list[str] = Field(default_factory=list)
    warnings: list[EditWarning] = Field(default_factory=list)


class View(ServerEnvelope):
    """Answer to render."""

    type: Literal["view"] = "view"
    t_us: Microseconds
    revision: int
    frames: list[Frame]
    clouds: list[PointCloud] = Field(default_factory=list)
    timing: dict[str, float] = Field(default_factory=dict)


class Driven(ServerEnvelope):
    """Answer to agent."""

    type: Literal["driven"] = "driven"
    object_id: str
    step: int = Field(description="step from which the plan is followed")


class Kept(ServerEnvelope):
    """Answer to snapshot."""

    type: Literal["kept"] = "kept"
    name: str
    step: int
    t_us: Microseconds


class Forked(ServerEnvelope):
    """Answer to fork: another session with the same state."""

    type: Literal["forked"] = "forked"
    session_id: str
    token: str = Field(repr=False)
    ws_url: str
    step: int


class Progress(ServerEnvelope):
    """Long work before welcome or obs is in progress."""

    type: Literal["progress"] = "progress"
    phase: str
    eta_s: float | None = None


class Error(ServerEnvelope):
    """A message was refused. The session continues unless `fatal`."""

    type: Literal["error"] = "error"
    code: str
    detail: str
    hint: str | None = None
    retryable: bool = False
    fatal: bool = Field(default=False, description="the socket closes after this message")
    step: int | None = Field(default=None, description="current step of the session")
    retry_after_s: int | None = Field(
        default=None, description="if `retryable`: wait before sending it again"
    )


class Result(ServerEnvelope):
    """The session has ended."""

    type: Literal["result"] = "result"
    steps: int
    t_us: Microseconds | None
    reason: str | None
    metrics: dict[str, float]
    scores: list[Score] = Field(default_factory=list)


ServerMessage = Annotated[
    Welcome | Attached | Obs | Edited | View | Driven | Kept | Forked | Progress | Error | Result,
    Field(discriminator="type"),
]
SERVER_MESSAGE: TypeAdapter[ServerMessage] = TypeAdapter(ServerMessage)
