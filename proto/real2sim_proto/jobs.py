"""REST models of jobs: long work that answers at once and reports as it goes."""

from __future__ import annotations

from enum import StrEnum
from typing import Any, Literal

from pydantic import Field, model_validator

from .base import Identifier, Microseconds, Model, one_of
from .errors import Problem
from .scenes import Reply


class JobState(StrEnum):
    """Where a job is."""

    QUEUED = "queued"
    RUNNING = "running"
    SUCCEEDED = "succeeded"
    FAILED = "failed"
    CANCELLED = "cancelled"
    INTERRUPTED = "interrupted"
    """The worker stopped while it ran; start it again."""


OVER = frozenset({JobState.SUCCEEDED, JobState.FAILED, JobState.CANCELLED, JobState.INTERRUPTED})
"""States that last."""

JobKind = Literal["load_scene", "simulate", "export"]


class JobFile(Reply):
    """A file that a job left: `GET /v1/jobs/{id}/files/{name}`."""

    name: str
    media_type: str
    bytes: int


class JobInfo(Reply):
    """A job as it is now; also the data of each of its events."""

    job_id: str
    kind: str = one_of(JobKind)
    subject: str = Field(description="scene or scenario it works on")
    state: JobState
    progress: float = Field(default=0.0, ge=0, le=1)
    stage: str = Field(default="", description="what it is doing")
    event: int = Field(default=0, description="number of its newest event")
    who: str = Field(default="", description="who asked for it")
    owner: str = Field(default="default", description="name of the token it was asked for with")
    request: dict[str, Any] = Field(default_factory=dict)
    result: dict[str, Any] | None = Field(default=None, description="once it has succeeded")
    files: list[JobFile] = Field(default_factory=list)
    error: Problem | None = Field(default=None, description="why it failed")
    created_at: str = Field(description="UTC, ISO 8601")
    started_at: str | None = None
    finished_at: str | None = None

    @property
    def over(self) -> bool:
        """Whether it will not change any more."""
        return self.state in OVER


class JobList(Reply):
    """Jobs of a worker, newest first."""

    jobs: list[JobInfo]


class SimulateRequest(Model):
    """Body of `POST /v1/scenarios/{id}/simulate`: a physics rollout."""

    start_us: Microseconds | None = Field(default=None, description="default: of the scenario")
    end_us: Microseconds | None = Field(default=None, description="default: of the scenario")
    frame_us: int = Field(
        default=50_000, ge=5_000, le=1_000_000, description="time from one kept frame to the next"
    )
    objects: list[Identifier] | None = Field(
        default=None,
        max_length=64,
        description="what the physics moves; default: what has a velocity or physics of its own, "
        "and whatever that touches; 'ego': the recording vehicle, with a body of its size",
    )
    background: bool | None = Field(
        default=None,
        description="whether walls, poles, trees and all else that stands in the background "
        "stops what hits it; default: true. figures.background of the result says what was taken",
    )
    preset: Literal["vehicle", "paper"] = Field(
        default="vehicle", description="how objects become bodies: crumpling cars, or soft ones"
    )
    backend: Literal["auto", "cpu", "cuda", "reference"] = "auto"


class ExportRequest(Model):
    """Body of `POST /v1/exports`: a video of a scenario, a scene or a simulation."""

    kind: Literal["video"] = "video"
    scenario: Identifier | None = None
    scene: Identifier | None = None
    simulation: Identifier | None = Field(
        default=None, description="id of a finished simulate job, instead of both"
    )
    camera: Identifier
    width: int | None = Field(default=None, ge=16, le=4096, description="[px]; default: recorded")
    start_us: Microseconds | None = Field(default=None, description="default: of the scenario")
    end_us: Microseconds | None = Field(default=None, description="default: of the scenario")
    fps: float = Field(default=10.0, gt=0, le=60)

    @model_validator(mode="after")
    def _names_one_world(self) -> ExportRequest:
        given = [self.scenario, self.scene, self.simulation]
        if sum(name is not None for name in given) != 1:
            raise ValueError("name exactly one of scenario, scene and simulation")
        return self
