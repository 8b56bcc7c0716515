"""REST models of jobs: long-running work with progress reports."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Discriminator, Field, Tag, TypeAdapter, model_validator

from .base import Identifier, Microseconds, Model, Quaternion, Vector3, one_of
from .errors import Problem
from .operations import PhysicsValues, Size3
from .scenes import Reply


class JobState(StrEnum):
    """State of a job."""

    QUEUED = "queued"
    RUNNING = "running"
    SUCCEEDED = "succeeded"
    FAILED = "failed"
    CANCELLED = "cancelled"
    INTERRUPTED = "interrupted"
    """The worker stopped while the job was running; start the job again."""


OVER = frozenset({JobState.SUCCEEDED, JobState.FAILED, JobState.CANCELLED, JobState.INTERRUPTED})
"""Final states."""

JobKind = Literal["load_scene", "simulate", "calibrate", "export", "drive", "sweep"]

PlannerName = Literal["follow_route", "pid", "idm", "depth_sampling"]
"""Planners of the SDK that a worker can start."""


class JobFile(Reply):
    """A result file of a job: `GET /v1/jobs/{id}/files/{name}`."""

    name: str
    media_type: str
    bytes: int


class JobInfo(Reply):
    """Current state of a job; also the data of each of its events."""

    _instead: ClassVar = {"done": "job.over", "id": "job.job_id", "status": "job.state"}

    job_id: str
    kind: str = one_of(JobKind)
    subject: str = Field(description="scene or scenario of the job")
    state: JobState
    progress: float = Field(default=0.0, ge=0, le=1)
    stage: str = Field(default="", description="current activity")
    event: int = Field(default=0, description="number of its newest event")
    who: str = Field(default="", description="client that requested it")
    owner: str = Field(default="default", description="name of the token of the request")
    worker: str = Field(default="", description="worker that runs it and has its files")
    attempt: int = Field(default=1, ge=1, description="attempt; a job restarts if its worker dies")
    request: dict[str, Any] = Field(default_factory=dict)
    result: dict[str, Any] | None = Field(
        default=None, description="set once the job has succeeded"
    )
    files: list[JobFile] = Field(default_factory=list)
    error: Problem | None = Field(default=None, description="reason of the failure")
    created_at: str = Field(description="UTC, ISO 8601")
    started_at: str | None = None
    finished_at: str | None = None

    @property
    def over(self) -> bool:
        """Whether the state is final."""
        return self.state in OVER


class JobList(Reply):
    """Jobs of a worker, newest first."""

    jobs: list[JobInfo]


class DriveRequest(Model):
    """Body of `POST /v1/sessions/{id}/drive`: a planner drives the session, with a recording."""

    planner: PlannerName | None = Field(
        default="follow_route",
        description=(
            "planner of the SDK, run in a separate process: it resets the session to its "
            "initial options and drives from there. null waits for your planner, on the "
            "drive socket (`real2sim drive --session`) or by `POST .../step`, and continues "
            "from the current step"
        ),
    )
    steps: int | None = Field(
        default=None,
        ge=1,
        le=100_000,
        description="number of steps; default: to the end of the episode",
    )


class SimulateRequest(Model):
    """Body of `POST /v1/scenarios/{id}/simulate`: a physics rollout."""

    start_us: Microseconds | None = Field(default=None, description="default: the scenario's")
    end_us: Microseconds | None = Field(default=None, description="default: the scenario's")
    frame_us: int = Field(
        default=50_000, ge=5_000, le=1_000_000, description="time between kept frames"
    )
    objects: list[Identifier] | None = Field(
        default=None,
        max_length=64,
        description=(
            "objects to simulate; default: those with a velocity or physics properties, and "
            "all that they touch; 'ego': the recording vehicle, with a body of its size"
        ),
    )
    background: bool | None = Field(
        default=None,
        description=(
            "whether walls, poles, trees and other background geometry act as obstacles; "
            "default: true. figures.background of the result lists them"
        ),
    )
    preset: Literal["vehicle", "paper"] | None = Field(
        default=None,
        description=(
            "body model: crumpling cars (default), or soft bodies (default for the paper's "
            "experiments)"
        ),
    )
    physics: dict[Identifier | Literal["*"], PhysicsValues] = Field(
        default_factory=dict,
        max_length=64,
        description=(
            "physics properties by object for this rollout, overriding set_physics; '*' "
            "means all simulated objects"
        ),
    )
    gravity: Vector3 | None = Field(
        default=None,
        description="[m/s^2]; default: (0, 0, -9.81), or zero in the experiment pair",
    )
    max_particles: int | None = Field(
        default=None,
        ge=100,
        le=4_000_000,
        description="largest number of particles of all bodies; default: 400,000",
    )
    experiment: Literal["wall", "pair", "drop", "frontal", "t_bone", "pole", "roof"] | None = Field(
        default=None,
        description=(
            "experiment of the paper (an object against a wall, the first half of the "
            "objects into the others, or objects dropped) or crash test; sets its own "
            "colliders and duration"
        ),
    )
    speed: Annotated[float, Field(gt=0, le=100)] | None = Field(
        default=None, description="speed of an experiment [m/s]; default: the paper's"
    )
    backend: Literal["auto", "cpu", "cuda", "reference"] = "auto"

    @model_validator(mode="after")
    def _speed_is_an_experiments(self) -> SimulateRequest:
        if self.speed is not None and self.experiment is None:
            raise ValueError("speed is of an experiment; give an object one with set_velocity")
        return self


Sigma = Annotated[float, Field(gt=0, le=100)]


class ObservedBox(Model):
    """Position of an object from a tracker."""

    t_us: Microseconds
    position: Vector3 = Field(description="box centre, world [m]")
    quaternion: Quaternion | None = Field(default=None, description="default: unknown")
    size: Size3 | None = Field(
        default=None, description="size of the observed box [m]; default: unknown"
    )


class SeenPoint(Model):
    """Position of a marked point."""

    t_us: Microseconds
    position: Vector3 = Field(description="world [m]")


class ObservedPoint(Model):
    """A tracked point of an object; omit times at which it was not visible."""

    place: Vector3 = Field(description="point on the undeformed object, object frame [m]")
    seen: list[SeenPoint] = Field(min_length=1, max_length=1000)


class ObservedImage(Model):
    """An image from a camera of the scene, at the recording vehicle's pose."""

    t_us: Microseconds
    camera: Identifier
    image: str = Field(max_length=2_000_000, description="PNG or JPEG as base64; of any size")


class Observations(Model):
    """Observations of an object; all of them are used together."""

    recorded: bool = Field(
        default=False, description="use the boxes of its recorded track within the simulated span"
    )
    boxes: list[ObservedBox] = Field(default_factory=list, max_length=2000)
    points: list[ObservedPoint] = Field(default_factory=list, max_length=256)
    images: list[ObservedImage] = Field(default_factory=list, max_length=64)
    position_sigma: Sigma = Field(
        default=0.05, description="standard deviation of box positions [m]"
    )
    heading_sigma: Sigma = Field(
        default=0.02, description="standard deviation of box headings [rad]"
    )
    size_sigma: Sigma = Field(default=0.05, description="standard deviation of box sizes [m]")
    point_sigma: Sigma = Field(default=0.02, description="standard deviation of points [m]")
    image_sigma: Sigma = Field(
        default=0.05, description="standard deviation of pixel values, as a fraction of white"
    )

    @model_validator(mode="after")
    def _saw_something(self) -> Observations:
        if not (self.recorded or self.boxes or self.points or self.images):
            raise ValueError("nothing was observed: give recorded, boxes, points or images")
        return self


CalibratedName = Literal["stiffness", "yield_stress", "viscosity", "friction", "speed"]


class CalibrateRequest(Model):
    """Body of `POST /v1/scenarios/{id}/calibrate`: fit parameters of an object to observations."""

    object_id: Identifier
    parameters: list[CalibratedName] = Field(
        min_length=1,
        max_length=5,
        description="parameters to fit, as factors on the initial values",
    )
    observations: Observations
    simulate: SimulateRequest = Field(
        default_factory=SimulateRequest,
        description=(
            "simulation with initial values; `objects` defaults to this object alone, and "
            "the end follows from the observations"
        ),
    )
    steps: int = Field(default=12, ge=1, le=60, description="largest number of iterations")


class ExportRequest(Model):
    """Body of `POST /v1/exports`: a video of a scenario, a scene or a simulation."""

    kind: Literal["video"] = "video"
    scenario: Identifier | None = None
    scene: Identifier | None = None
    simulation: Identifier | None = Field(
        default=None, description="id of a finished simulate job, instead of scene and scenario"
    )
    camera: Identifier
    width: int | None = Field(default=None, ge=16, le=4096, description="[px]; default: recorded")
    start_us: Microseconds | None = Field(default=None, description="default: the scenario's")
    end_us: Microseconds | None = Field(default=None, description="default: the scenario's")
    fps: float = Field(default=10.0, gt=0, le=60)

    @model_validator(mode="after")
    def _names_one_world(self) -> ExportRequest:
        given = [self.scenario, self.scene, self.simulation]
        if sum(name is not None for name in given) != 1:
            raise ValueError("name exactly one of scenario, scene and simulation")
        return self


SweptValue = float | int | str | bool
Pair = tuple[float, float]


class SweptValues(Model):
    """Values of a sweep's parameter: exactly one of these."""

    values: list[SweptValue] | None = Field(default=None, min_length=1, max_length=1000)
    range: tuple[float, float, Annotated[int, Field(ge=1, le=1000)]] | None = Field(
        default=None, description="first, last and number of evenly spaced values"
    )
    uniform: Pair | None = Field(
        default=None, description="lower and upper limit of a uniform draw"
    )
    normal: tuple[float, Annotated[float, Field(ge=0)]] | None = Field(
        default=None, description="mean and standard deviation of a normal draw"
    )

    @model_validator(mode="after")
    def _is_one(self) -> SweptValues:
        given = (self.values, self.range, self.uniform, self.normal)
        if sum(value is not None for value in given) != 1:
            raise ValueError("give exactly one of values, range, uniform and normal")
        if self.uniform is not None and self.uniform[0] > self.uniform[1]:
            raise ValueError("the lower bound of uniform must come first")
        return self

    @property
    def is_drawn(self) -> bool:
        """Whether it has a distribution."""
        return self.uniform is not None or self.normal is not None


class DatasetSweep(Model):
    """Repeats the same drive with other parameter values in its edits."""

    parameters: dict[Identifier, SweptValues] = Field(min_length=1, max_length=16)
    draws: int = Field(
        default=1, ge=1, le=1000, description="draws from distributions for each combination"
    )
    operations: list[dict[str, Any]] = Field(
        min_length=1,
        max_length=64,
        description=(
            'edits applied after those of the scenario; "$name" inserts a parameter\'s value'
        ),
    )


class DatasetPerturbation(Model):
    """Clips whose ego starts off its path and returns to it in its future trajectory."""

    lateral_sigma: float = Field(
        default=0.5, ge=0, le=5, description="lateral offset from the path [m]"
    )
    heading_sigma: float = Field(
        default=0.07, ge=0, le=0.6, description="heading relative to the path [rad]"
    )
    recover_s: float = Field(
        default=3.0, ge=0.5, le=30, description="time to return to the path [s]"
    )
    copies: int = Field(default=1, ge=1, le=100, description="number of copies of each clip")


class DatasetNoise(Model):
    """Simulated detections, in addition to the true boxes."""

    position: float = Field(default=0.0, ge=0, le=10, description="standard deviation [m]")
    size: float = Field(
        default=0.0, ge=0, le=1, description="relative standard deviation of each edge"
    )
    heading: float = Field(default=0.0, ge=0, le=3.2, description="[rad]")
    missed: float = Field(default=0.0, ge=0, le=1, description="share of missed objects")
    false: float = Field(default=0.0, ge=0, le=100, description="false detections per frame")


DatasetFormat = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]{0,31}$")]
SplitName = Annotated[str, Field(pattern=r"^[A-Za-z0-9_]{1,32}$")]
Share = Annotated[float, Field(ge=0, le=1e6)]

MAX_RECORDING_TEXT = 3_500_000
"""Maximum length of a recording in a request, in characters; leaves room for the rest of the
body."""


class DatasetRequest(Model):
    """Body of `POST /v1/exports`: a labelled data set."""

    kind: Literal["dataset"]
    scenario: Identifier | None = Field(
        default=None, description="scenario in its present revision, driven as recorded"
    )
    scene: Identifier | None = Field(
        default=None,
        description="scene as recorded; with `recording`, the scene of the recording",
    )
    session: Identifier | None = Field(
        default=None,
        description="the session's episode so far; needs the session's token or one of the worker",
    )
    recording: str | None = Field(
        default=None,
        max_length=MAX_RECORDING_TEXT,
        description="an episode on `scene`: a file of `GET /v1/sessions/{id}/recording`, base64",
    )
    formats: list[DatasetFormat] = Field(
        min_length=1,
        max_length=16,
        description=(
            "labels, kitti, coco, nuscenes, argoverse2, webdataset, pictures ...; see "
            "docs/datasets.md"
        ),
    )
    cameras: list[Identifier] = Field(
        default_factory=list, max_length=64, description="default: all cameras of the scene"
    )
    width: int | None = Field(default=None, ge=16, le=8192, description="[px]; default: recorded")
    period_us: int = Field(
        default=100_000, ge=1_000, le=60_000_000, description="time between frames"
    )
    start_us: Microseconds | None = Field(default=None, description="default: the source's")
    end_us: Microseconds | None = Field(default=None, description="default: the source's")
    clip_s: float = Field(
        default=20.0, gt=0, le=3600, description="length of a clip; each clip is in one split [s]"
    )
    splits: dict[SplitName, Share] = Field(
        default_factory=lambda: {"train": 1.0},
        min_length=1,
        max_length=16,
        description="share of the clips by name",
    )
    seed: int = Field(
        default=0, ge=0, le=2**53, description="seed of the assignment of clips to splits"
    )
    flow: bool = Field(default=True, description="export optical flow")
    lidar: Identifier | None = Field(
        default=None,
        description=(
            "name in the catalogue (docs/lidar.md) of the LiDAR whose returns are labelled; "
            "default: points on the surfaces that the cameras see"
        ),
    )
    rig: dict[str, Any] | None = Field(
        default=None, description="your own cameras and LiDAR, instead; see docs/datasets.md"
    )
    sweep: DatasetSweep | None = None
    perturb: DatasetPerturbation | None = None
    noise: DatasetNoise | None = None
    dry_run: bool = Field(
        default=False,
        description="return the number of frames, images, bytes and minutes without exporting",
    )

    @model_validator(mode="after")
    def _names_one_source(self) -> DatasetRequest:
        if sum(name is not None for name in (self.scenario, self.scene, self.session)) != 1:
            raise ValueError("name exactly one of scenario, scene and session")
        if self.recording is not None and self.scene is None:
            raise ValueError("a recording needs the scene that it was made in")
        if self.sweep is not None and (self.recording is not None or self.session is not None):
            raise ValueError(
                "a sweep varies a scene or a scenario; a recorded episode cannot change"
            )
        if self.rig is not None and (self.cameras or self.width or self.lidar):
            raise ValueError("a rig replaces cameras, width and lidar: leave those out")
        return self


def _export_kind(body: Any) -> str:
    kind = body.get("kind", "video") if isinstance(body, dict) else getattr(body, "kind", "video")
    return kind if isinstance(kind, str) else ""


ExportBody = Annotated[
    Annotated[ExportRequest, Tag("video")] | Annotated[DatasetRequest, Tag("dataset")],
    Discriminator(
        _export_kind,
        custom_error_type="export_kind",
        custom_error_message="kind is video (default) or dataset",
    ),
]
"""Body of `POST /v1/exports`, by `kind`; default: video."""

EXPORT_BODY: TypeAdapter[ExportRequest | DatasetRequest] = TypeAdapter(ExportBody)
