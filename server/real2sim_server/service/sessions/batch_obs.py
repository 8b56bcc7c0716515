"""Instants of many worlds as one message: a row of each array for a world."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from real2sim_proto.drive_batch import COMMANDS, EGO_COLUMNS

from ...world import Observation, agent_fields
from ...world.ego.route import WAYPOINTS
from ..http.problems import ServiceError
from ..rendering.frames import EncodedFrame
from .batch_images import pack_images
from .handshake import error_fields
from .wire import EncodedMessage, pack_members, pack_message, pack_with_images

NUMBER_OF = {command: k for k, command in enumerate(COMMANDS)}
MOTION = ("yaw", "speed", "lateral_speed", "acceleration", "steering", "yaw_rate")


def pack_batch_obs(
    seen: Mapping[int, Observation],
    errors: Mapping[int, tuple[ServiceError, int | None]],
    timing_ms: Mapping[str, float],
    *,
    frames: Mapping[int, Sequence[EncodedFrame]],
) -> EncodedMessage:
    """The wire's BatchObs, without id.

    Args:
        seen: by number of the world, in the order asked for.
        errors: why a world has no row, and the step that it is at.
        timing_ms: by stage.
        frames: images by number of the world, of those that have any.
    """
    found = list(seen.values())
    fields: dict[str, Any] = {
        "worlds": np.array(list(seen), np.int64),
        "step": np.array([o.step for o in found], np.int64),
        "t_us": np.array([o.t_us for o in found], np.int64),
        "revision": np.array([o.revision for o in found], np.int64),
        "ego": np.array([_ego_row(o.ego_fields()) for o in found]).reshape(-1, len(EGO_COLUMNS)),
        "command": np.array([NUMBER_OF[o.command] for o in found], np.uint8),
        "route": np.array([o.route for o in found]).reshape(-1, WAYPOINTS, 2),
        "metrics": _columns([o.metrics for o in found]),
        "terminated": np.array([o.terminated for o in found], np.bool_),
        "truncated": np.array([o.truncated for o in found], np.bool_),
        "warming_up": np.array([o.warming_up for o in found], np.bool_),
        "lap": np.array([o.lap for o in found], np.int64),
        "reverse": np.array([o.motion.reversing for o in found], np.bool_),
        "events": [{"world": w, **e.fields()} for w, o in seen.items() for e in o.events],
        "details": [detail for w, o in seen.items() if (detail := _detail(w, o))],
        "errors": pack_errors(errors),
        "timing": dict(timing_ms),
    }
    if not frames:
        return pack_message("batch_obs", fields)
    return pack_with_images("batch_obs", pack_members(fields), pack_images(frames))


def pack_errors(errors: Mapping[int, tuple[ServiceError, int | None]]) -> list[dict[str, Any]]:
    """The wire's WorldErrors."""
    return [{"world": w, **error_fields(e, step=step)} for w, (e, step) in sorted(errors.items())]


def _ego_row(fields: Mapping[str, Any]) -> tuple[float, ...]:
    return (*fields["position"], *fields["quaternion"], *(fields[name] for name in MOTION))


def _columns(metrics: Sequence[Mapping[str, float]]) -> dict[str, NDArray[np.float64]]:
    """[M] by name, nan where a world has no such metric."""
    names = dict.fromkeys(name for row in metrics for name in row)
    return {name: np.array([row.get(name, math.nan) for row in metrics]) for name in names}


def _detail(world: int, seen: Observation) -> dict[str, Any]:
    """What few worlds have; empty where there is nothing to say."""
    found: dict[str, Any] = {}
    if seen.reason is not None:
        found["reason"] = seen.reason
    if seen.drawn:
        found["drawn"] = dict(seen.drawn)
    if seen.truth is not None:
        found["ego_truth"] = seen.truth_fields()
    if seen.agents is not None:
        found["agents"] = agent_fields(seen.agents)
    if seen.lanes:
        found["lanes"] = [piece.fields() for piece in seen.lanes]
    return {"world": world, **found} if found else {}
