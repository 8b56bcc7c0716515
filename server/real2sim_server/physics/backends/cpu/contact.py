"""Contact on the fields of one block: bodies with each other, bodies with colliders."""

from __future__ import annotations

from typing import Any

from ...contact.node import pair_friction, resolve_node_collider, resolve_node_pair
from ...numerics.device import ZERO
from ..kernel import inner
from ..layout import BLOCK
from ..particle import node_position


@inner()
def resolve_collider_contact(field: Any, layout: Any, work: Any, params: Any) -> None:
    """Contact of one body's field with every collider near it."""
    friction = params.friction[layout.field_body[field]]
    for contact in range(layout.contact_start[field], layout.contact_start[field + 1]):
        row = params.collider_rows[layout.contact_collider[contact]]
        total = work.by_collider[contact]
        for node in range(BLOCK**3):
            if work.velocity[field, node, 3] > ZERO:
                at = node_position(layout.field_coordinates[field], node, params.dx)
                resolve_node_collider(
                    row, params.heights, params.dx, friction, at,
                    work.velocity[field, node], work.offset[field, node], total,
                )  # fmt: skip


@inner()
def resolve_body_contact(begin: Any, end: Any, layout: Any, work: Any, params: Any) -> None:
    """Contact of every two bodies in one block, pair after pair (Bardenhagen et al. 2001)."""
    for a in range(begin, end):
        for b in range(a + 1, end):
            body_a, body_b = layout.field_body[a], layout.field_body[b]
            friction = pair_friction(params.friction[body_a], params.friction[body_b])
            for node in range(BLOCK**3):
                if work.velocity[a, node, 3] > ZERO and work.velocity[b, node, 3] > ZERO:
                    at = node_position(layout.field_coordinates[a], node, params.dx)
                    resolve_node_pair(
                        work.velocity[a, node], work.velocity[b, node],
                        work.offset[a, node], work.offset[b, node],
                        friction, params.dx, at, work.by_body[a, body_b], work.by_body[b, body_a],
                    )  # fmt: skip
