"""Contact on the fields of one block: bodies with each other, bodies with colliders."""

from __future__ import annotations

from typing import Any

from ...constitutive.shared import ZERO
from ..kernel import inner
from ..layout import BLOCK
from ..node_contact import meet_node, meet_obstacle, node_position, pair_friction


@inner()
def resolve_collider_contact(field: Any, layout: Any, work: Any, rules: Any) -> None:
    """Contact of one body's field with every collider near it."""
    friction = rules.friction[layout.field_body[field]]
    for touch in range(layout.touch_start[field], layout.touch_start[field + 1]):
        row = rules.obstacles[layout.touch_collider[touch]]
        total = work.by_collider[touch]
        for node in range(BLOCK**3):
            if work.velocity[field, node, 3] > ZERO:
                at = node_position(layout.field_block[field], node, rules.dx)
                meet_obstacle(
                    row, rules.heights, rules.dx, friction, at,
                    work.velocity[field, node], work.offset[field, node], total,
                )  # fmt: skip


@inner()
def resolve_body_contact(begin: Any, end: Any, layout: Any, work: Any, rules: Any) -> None:
    """Contact of every two bodies in one block, pair after pair (Bardenhagen et al. 2001)."""
    for a in range(begin, end):
        for b in range(a + 1, end):
            body_a, body_b = layout.field_body[a], layout.field_body[b]
            friction = pair_friction(rules.friction[body_a], rules.friction[body_b])
            for node in range(BLOCK**3):
                if work.velocity[a, node, 3] > ZERO and work.velocity[b, node, 3] > ZERO:
                    at = node_position(layout.field_block[a], node, rules.dx)
                    meet_node(
                        work.velocity[a, node], work.velocity[b, node],
                        work.offset[a, node], work.offset[b, node],
                        friction, rules.dx, at, work.by_body[a, body_b], work.by_body[b, body_a],
                    )  # fmt: skip
