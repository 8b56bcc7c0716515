"""What a session's log holds: msgpack of exactly what was asked for."""

from __future__ import annotations

from collections.abc import Sequence

from real2sim_proto import encode
from real2sim_proto.drive import Plan, ResetSpec
from real2sim_proto.operations import Operation

KEPT_PLAN = encode({"plan": None})
"""Payload of an action that goes on with the plan before it."""


def reset_payload(spec: ResetSpec) -> bytes:
    """Of the beginning of an episode."""
    return encode({"spec": spec.model_dump(mode="json")})


def plan_payload(plan: Plan) -> bytes:
    """Of an action. Equal plans have equal bytes, whichever way they came over the wire."""
    return encode({"plan": plan.model_dump()})


def edit_payload(operations: Sequence[Operation]) -> bytes:
    """Of an edit."""
    return encode({"operations": [operation.model_dump(mode="json") for operation in operations]})
