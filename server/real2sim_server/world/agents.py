"""Poses of all objects at one instant."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..edit import ObjectState, PlacedObjects

Agents = PlacedObjects[ObjectState]
"""Where all objects are at one instant."""


def rows_of(agents: Agents) -> dict[str, int]:
    """The row of each object, by id."""
    return {o.object_id: k for k, o in enumerate(agents.objects)}


def rows_in(before: Agents, after: Agents) -> NDArray[np.int64]:
    """The row in ``before`` of each object of ``after``, [K] int64; -1 where it was not there."""
    if before.objects is after.objects:
        return _all_rows(len(after.objects))
    rows = rows_of(before)
    return np.array([rows.get(o.object_id, -1) for o in after.objects], np.int64)


@lru_cache(maxsize=64)
def _all_rows(count: int) -> NDArray[np.int64]:
    """Shared by all who ask: nobody writes into it."""
    return np.arange(count)


def agent_fields(agents: Agents) -> list[dict[str, Any]]:
    """The wire's AgentState of each object, as plain maps."""
    poses = zip(
        agents.objects,
        agents.positions.tolist(),
        agents.quaternions.tolist(),
        agents.velocities.tolist(),
        agents.sizes.tolist(),
        strict=True,
    )
    return [
        {
            "object_id": subject.object_id,
            "category": subject.category,
            "position": position,
            "quaternion": quaternion,
            "velocity": velocity,
            "size": size,
        }
        for subject, position, quaternion, velocity, size in poses
    ]
