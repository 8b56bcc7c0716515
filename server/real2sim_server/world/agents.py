"""Poses of all objects at one instant."""

from __future__ import annotations

from typing import Any

from ..edit import ObjectState, PlacedObjects

Agents = PlacedObjects[ObjectState]
"""Where all objects are at one instant."""


def rows_of(agents: Agents) -> dict[str, int]:
    """The row of each object, by id."""
    return {o.object_id: k for k, o in enumerate(agents.objects)}


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
