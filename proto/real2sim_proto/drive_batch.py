"""Messages of the batch socket: one message steps the worlds of many sessions.

A batch is a list of sessions; its worlds are numbered from 0 in the order in which ``batch_hello``
names them. What they share goes as arrays with a row for each world, in the order of ``worlds``.
Each session stays what it is: it has its log, its recordings and its calls of REST, and does bit
for bit what it would do on a drive socket of its own.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal, get_args

import numpy as np
from pydantic import BeforeValidator, Field, TypeAdapter, model_validator

from .base import Codec, Identifier, Microseconds, Modality, Model, Vector3
from .drive import (
    AgentState,
    Array,
    EgoState,
    Envelope,
    Error,
    Event,
    LaneShown,
    Progress,
    Result,
    ServerEnvelope,
    ServerModel,
)
from .episode import ResetSpec
from .plans import MAX_PLAN_POSES

MAX_WORLDS = 256
"""Sessions on one batch socket."""

EGO_COLUMNS = (
    "x",
    "y",
    "z",
    "qw",
    "qx",
    "qy",
    "qz",
    "yaw",
    "speed",
    "lateral_speed",
    "acceleration",
    "steering",
    "yaw_rate",
)
"""Columns of ``ego``: the members of :class:`EgoState` but ``gear`` and ``size``, one after the
other."""

BatchCommand = Literal["straight", "left", "right"]
COMMANDS: tuple[str, ...] = get_args(BatchCommand)
"""What the numbers of ``command`` stand for."""

Rows = Annotated[
    list[Annotated[int, Field(ge=0, lt=MAX_WORLDS)]],
    BeforeValidator(lambda value: value.tolist() if isinstance(value, np.ndarray) else value),
    Field(min_length=1, max_length=MAX_WORLDS),
]
"""Numbers of worlds."""


def _array(value: Any) -> Any:
    if isinstance(value, list | tuple):
        value = np.asarray(value)
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "iuf":
        raise ValueError("an array of numbers is expected")
    return value


NumberArray = Annotated[Array, BeforeValidator(_array)]


def _flags(value: Any) -> Any:
    if isinstance(value, list | tuple):
        value = np.asarray(value)
    if not isinstance(value, np.ndarray) or value.dtype.kind != "b":
        raise ValueError("an array of booleans is expected")
    return value


Flags = Annotated[Array, BeforeValidator(_flags)]


# --- client to server -------------------------------------------------------------------------


class BatchMember(Model):
    """One session of a batch."""

    session_id: Identifier
    token: str | None = Field(default=None, max_length=500, description="of the session")
    resume_token: str | None = Field(
        default=None,
        max_length=500,
        description="of an earlier welcome: takes the place of the controller that had it",
    )


class BatchHello(Envelope):
    """First message on a batch socket; answered by `batch_welcome`."""

    type: Literal["batch_hello"] = "batch_hello"
    protocols: list[str] = Field(min_length=1, max_length=16)
    sdk: str = Field(default="", max_length=100, description="name and version of the client")
    token: str | None = Field(
        default=None, max_length=500, description="of the worker; opens every session"
    )
    sessions: list[BatchMember] = Field(min_length=1, max_length=MAX_WORLDS)


class BatchReset(Envelope):
    """Starts episodes; answered by `batch_obs`."""

    type: Literal["batch_reset"] = "batch_reset"
    spec: ResetSpec = ResetSpec()
    worlds: Rows | None = Field(default=None, description="default: all")
    seeds: list[Annotated[int, Field(ge=0, lt=2**63)]] | None = Field(
        default=None, description="one a world, in place of the seed of `spec`"
    )
    start_us: list[Microseconds] | None = Field(
        default=None, description="one a world, in place of that of `spec`"
    )


class ControlPlans(Model):
    """Direct actuation for one step in M worlds."""

    kind: Literal["control"] = "control"
    values: NumberArray = Field(
        description="[M, 2] float64, acceleration [m/s^2] and road-wheel angle [rad]"
    )
    reverse: Flags | None = Field(default=None, description="[M] bool, in reverse gear; none")


class TrajectoryPlans(Model):
    """Where M vehicles should be, K poses each."""

    kind: Literal["trajectory"] = "trajectory"
    times_us: NumberArray = Field(
        description=f"[M, K] int64 absolute simulation time, K <= {MAX_PLAN_POSES}"
    )
    poses: NumberArray = Field(description="[M, K, 3] x [m], y [m], yaw [rad]")
    frame: Literal["vehicle", "world"] = "vehicle"


class PosePlans(Model):
    """Puts M vehicles somewhere."""

    kind: Literal["pose"] = "pose"
    values: NumberArray = Field(description="[M, 3] float64, x, y [m], yaw [rad], world")


Plans = Annotated[ControlPlans | TrajectoryPlans | PosePlans, Field(discriminator="kind")]
PLANS: TypeAdapter[Plans] = TypeAdapter(Plans)


class BatchAction(Envelope):
    """Answers the newest instant of each of its worlds; moves each clock by one dt."""

    type: Literal["batch_action"] = "batch_action"
    steps: NumberArray = Field(description="[M] int64, the step that each world is at")
    plans: Plans
    worlds: Rows | None = Field(default=None, description="default: all")

    @model_validator(mode="after")
    def _rows_agree(self) -> BatchAction:
        """Every array has a row for each world."""
        if self.steps.ndim != 1 or self.steps.dtype.kind == "f":
            raise ValueError(f"steps is {_form(self.steps)}; [M] of integers is expected")
        rows = len(self.steps)
        if self.worlds is not None and len(self.worlds) != rows:
            raise ValueError(f"{rows} steps for {len(self.worlds)} worlds")
        plans = self.plans
        if isinstance(plans, TrajectoryPlans):
            if plans.times_us.dtype.kind == "f":
                raise ValueError(f"times_us is {_form(plans.times_us)}; integers are expected")
            times, poses = plans.times_us.shape, plans.poses.shape
            if len(times) != 2 or poses != (*times, 3) or times[0] != rows:
                raise ValueError(
                    f"times_us {list(times)} and poses {list(poses)} for {rows} worlds; expected "
                    f"are [{rows}, K] and [{rows}, K, 3]"
                )
            return self
        reverse = plans.reverse if isinstance(plans, ControlPlans) else None
        if reverse is not None and reverse.shape != (rows,):
            raise ValueError(f"reverse is {_form(reverse)}; [{rows}] is expected")
        columns = 2 if isinstance(plans, ControlPlans) else 3
        if plans.values.shape != (rows, columns):
            raise ValueError(
                f"values of kind {plans.kind!r} are {list(plans.values.shape)}; expected is "
                f"[{rows}, {columns}]"
            )
        return self


class BatchBye(Envelope):
    """Ends all sessions of the batch; the answer is `batch_result`."""

    type: Literal["batch_bye"] = "batch_bye"


BatchClientMessage = Annotated[
    BatchHello | BatchReset | BatchAction | BatchBye, Field(discriminator="type")
]
BATCH_CLIENT_MESSAGE: TypeAdapter[BatchClientMessage] = TypeAdapter(BatchClientMessage)


# --- server to client -------------------------------------------------------------------------


class BatchWorldInfo(ServerModel):
    """One world of a batch as it is when the socket opens."""

    session_id: str
    scene: str
    step: int | None = Field(description="of the running episode; None before reset")
    revision: int = Field(default=0, description="of the session's edits")
    resume_token: str = Field(description="lets the controller come back")
    ego_size: Vector3 = Field(description="box length, width, height [m]")
    start_us: Microseconds
    end_us: Microseconds


class BatchWelcome(ServerEnvelope):
    """Answer to `batch_hello`."""

    type: Literal["batch_welcome"] = "batch_welcome"
    protocol: str
    versions: dict[str, str] = Field(description="server, metrics")
    limits: dict[str, int]
    worlds: list[BatchWorldInfo]


class WorldEvent(Event):
    """Something that happened in a world in this step."""

    world: int


class WorldDetail(ServerModel):
    """What few worlds have; there where there is something to say."""

    world: int
    reason: str | None = Field(default=None, description="why its episode has ended")
    drawn: dict[str, float] = Field(default_factory=dict, description="as of `obs`")
    ego_truth: EgoState | None = Field(default=None, description="as of `obs`")
    agents: list[AgentState] = Field(default_factory=list, description="of privileged episodes")
    lanes: list[LaneShown] = Field(default_factory=list, description="as of `obs`")


class WorldError(ServerModel):
    """A world that stays where it is, and why; as `error`."""

    world: int
    code: str
    detail: str
    hint: str | None = None
    retryable: bool = False
    step: int | None = Field(default=None, description="step the session is at")
    retry_after_s: int | None = None


class BatchImages(ServerModel):
    """Images of one sensor and one modality in those worlds that show it now, all of one form."""

    sensor: str
    modality: Modality
    codec: Codec
    dtype: Literal["uint8", "uint16", "float32"]
    shape: list[int] = Field(description="[H, W, 3] or [H, W], of each image")
    K: Array = Field(description="[3, 3] float64 intrinsics [px]")
    worlds: Array = Field(description="[I] int64, whose images these are")
    T_world_sensor: Array = Field(description="[I, 4, 4] float64, camera frame to world")
    sizes: Array = Field(description="[I] int64 bytes of each image")
    data: bytes = Field(description="the images, one after the other")


class BatchObs(ServerEnvelope):
    """New instants of M worlds; a world with an error has no row."""

    type: Literal["batch_obs"] = "batch_obs"
    worlds: Array = Field(description="[M] int64, numbers of the worlds, in the order asked for")
    step: Array = Field(description="[M] int64")
    t_us: Array = Field(description="[M] int64")
    revision: Array = Field(description="[M] int64, of the session's edits")
    ego: Array = Field(description=f"[M, {len(EGO_COLUMNS)}] float64: {', '.join(EGO_COLUMNS)}")
    command: Array = Field(description="[M] uint8: 0 straight, 1 left, 2 right")
    route: Array = Field(description="[M, R, 2] float64 x, y of the route ahead, vehicle frame [m]")
    metrics: dict[str, Array] = Field(description="[M] float64; nan where a world has none")
    terminated: Array = Field(description="[M] bool")
    truncated: Array = Field(description="[M] bool")
    warming_up: Array = Field(description="[M] bool, the ego still moves as recorded")
    lap: Array = Field(description="[M] int64")
    reverse: Array = Field(description="[M] bool, the ego is in reverse gear")
    images: list[BatchImages] = Field(
        default_factory=list, description="of the sensors that are due"
    )
    events: list[WorldEvent] = Field(default_factory=list)
    details: list[WorldDetail] = Field(default_factory=list)
    errors: list[WorldError] = Field(default_factory=list)
    timing: dict[str, float] = Field(default_factory=dict, description="milliseconds by stage")


class WorldResult(Result):
    """The session of a world is over."""

    world: int
    type: Literal["result"] = "result"


class BatchResult(ServerEnvelope):
    """All sessions of the batch are over, but those with an error."""

    type: Literal["batch_result"] = "batch_result"
    results: list[WorldResult]
    errors: list[WorldError] = Field(default_factory=list)


BatchServerMessage = Annotated[
    BatchWelcome | BatchObs | BatchResult | Progress | Error, Field(discriminator="type")
]
BATCH_SERVER_MESSAGE: TypeAdapter[BatchServerMessage] = TypeAdapter(BatchServerMessage)


def _form(array: Any) -> str:
    return f"{array.dtype} {list(array.shape)}"
