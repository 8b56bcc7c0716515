"""Sessions as the wire has them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from typing import Any

from real2sim_proto import DRIVE_SUBPROTOCOL
from real2sim_proto.codec import MAX_CLIENT_MESSAGE_BYTES
from real2sim_proto.episode import MAX_SENSORS
from real2sim_proto.scenarios import MAX_OPERATIONS_PER_REQUEST
from real2sim_proto.sessions import SessionEdited, SessionInfo, SessionState

from ...edit import EditOutcome
from ...world import (
    Event,
    LoggedPath,
    Score,
    World,
    agent_fields,
    ego_fields,
    metrics_version,
    plan_in_world,
)
from ...world.ego.plan import PlannedTrajectory
from ...world.path import whole_route
from ..library.views import camera_infos, edited_objects
from .sensors import MAX_IMAGE_BYTES
from .session import Session


def session_info(session: Session, *, ws_base: str, token: str = "") -> SessionInfo:
    """A session; only its creator gets the token."""
    world, row = session.world, session.row
    created = datetime.fromtimestamp(row.created_us / 1e6, UTC)
    return SessionInfo(
        session_id=row.session_id,
        scene=row.scene,
        scenario_id=row.scenario_id,
        ws_url=f"{ws_base}/v1/sessions/{row.session_id}/drive",
        token=token,
        owner=row.owner,
        created_at=created.isoformat(timespec="milliseconds"),
        step=world.steps if world else None,
        t_us=world.t_us if world else None,
        controller=session.controller is not None,
        held=session.hold.held,
        reset=session.spec,
    )


def session_state(session_id: str, world: World, events: Iterable[Event]) -> SessionState:
    """Where everything is at an instant, and what happened before it."""
    seen = world.observe()
    return SessionState.model_validate(
        {
            "session_id": session_id,
            "step": world.steps,
            "t_us": world.t_us,
            "revision": world.revision,
            "ego": ego_fields(world.motion, world.T_world_vehicle, world.scene.ego_size),
            "agents": agent_fields(world.agents),
            "events": [event.fields() for event in events],
            "metrics": seen.metrics,
            "terminated": world.terminated,
            "truncated": world.truncated,
            "reason": world.reason,
            "lap": world.lap,
            "drawn": world.sampled,
        }
    )


def shown_state(session: Session) -> SessionState:
    """As :func:`session_state`, for those who look on: with the newest plan."""
    state = session_state(session.session_id, session.running_world(), tuple(session.events))
    newest = session.newest_plan
    plan = plan_in_world(newest.plan, newest.motion) if newest is not None else None
    return state.model_copy(
        update={
            "held": session.hold.held,
            "plan": [tuple(pose) for pose in plan.poses.tolist()]
            if isinstance(plan, PlannedTrajectory)
            else [],
            "planning_ms": newest.took_us / 1e3 if newest is not None and newest.took_us else None,
        }
    )


def session_edited(session_id: str, world: World, outcome: EditOutcome) -> SessionEdited:
    """What an edit of a running world led to."""
    return SessionEdited(
        session_id=session_id,
        step=world.steps,
        revision=world.revision,
        created=list(outcome.created),
        warnings=list(outcome.warnings),
    )


def welcome_fields(session: Session, role: str) -> dict[str, Any]:
    """Of the wire's Welcome, without envelope."""
    start, world = session.start, session.world
    objects = (world.state if world else start.state).visible
    infos = edited_objects(objects, start.summary, tracks=False)
    return {
        "protocol": DRIVE_SUBPROTOCOL,
        "session_id": session.session_id,
        "role": role,
        "versions": {
            "server": version("real2sim"),
            "scene_hash": session.row.scene_hash,
            "metrics": metrics_version(),
        },
        "limits": {
            "max_message_bytes": MAX_CLIENT_MESSAGE_BYTES,
            "max_operations_per_request": MAX_OPERATIONS_PER_REQUEST,
            "max_cameras_per_step": MAX_SENSORS,
            "max_image_bytes": MAX_IMAGE_BYTES,
        },
        "cameras": [c.model_dump(mode="json") for c in camera_infos(tuple(start.scene.rig))],
        "objects": [o.model_dump(mode="json", exclude_none=True) for o in infos],
        "route": whole_route(LoggedPath(start.scene.ego)),
        "start_us": start.scene.start_us,
        "end_us": start.scene.end_us,
        "step": world.steps if world else None,
        "revision": world.revision if world else 0,
        "resume_token": session.resume_token if role == "controller" else None,
    }


def result_fields(world: World | None, scores: Sequence[Score]) -> dict[str, Any]:
    """Of the wire's Result, without envelope; ``world``: the last instant, if an episode began."""
    return {
        "steps": world.steps if world else 0,
        "t_us": world.t_us if world else None,
        "reason": world.reason if world else None,
        "metrics": world.metrics() if world else {},
        "scores": [score.fields() for score in scores],
    }
