"""Other road users that repeat what was recorded, or what an edit made of it."""

from __future__ import annotations

from typing import Any

from ..edit import ObjectState, Placed

Agents = Placed[ObjectState]
"""Where all objects are at one instant."""


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
