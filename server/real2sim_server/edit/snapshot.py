"""A state as bytes and back, bit for bit, so that a long log need not be replayed whole."""

from __future__ import annotations

from dataclasses import replace
from types import MappingProxyType
from typing import Any

from pydantic import TypeAdapter

from real2sim_proto import CodecError, ErrorCode, decode, encode
from real2sim_proto.episode import AgentDriver
from real2sim_proto.operations import (
    AddCollider,
    EraseRegion,
    SetGait,
    SetPhysics,
    SetVelocity,
)
from real2sim_proto.storyboard import Storyboard, stored_storyboard

from ..scene import Trajectory
from .errors import EditError
from .state import AssetLookup, ObjectState, ScenarioState

MAX_BYTES = 256 * 1024 * 1024
_DRIVER: TypeAdapter[AgentDriver] = TypeAdapter(AgentDriver)


def pack_state(state: ScenarioState) -> bytes:
    """What differs from the recording, as msgpack; the recording itself is not in it."""
    changed = [o for o in state.objects.values() if state.recorded.get(o.object_id) is not o]
    story = {} if (board := state.storyboard) is None else {"story": board.model_dump(mode="json")}
    return encode(
        {
            "objects": [_packed_object(o) for o in changed],
            "next_instance_id": state.next_instance_id,
            "clock": list(state.clock),
            "regions": [r.model_dump(mode="json") for r in state.regions.values()],
            "colliders": [c.model_dump(mode="json") for c in state.colliders.values()],
            "gone": sorted(state.tombstones),
        }
        | story
    )


def unpack_state(initial: ScenarioState, packed: bytes) -> ScenarioState:
    """The state that :func:`pack_state` was given.

    Args:
        initial: of the same scene, before any edit.
        packed: the bytes.

    Raises:
        EditError: UNKNOWN_ASSET where an object shows one that is not in the library;
            INVALID_OPERATION for bytes that hold no state of this scene.
    """
    try:
        document = decode(packed, max_bytes=MAX_BYTES)
        found = [_unpacked_object(o, initial.assets) for o in document["objects"]]
        first, last = document["clock"]
        regions = [EraseRegion.model_validate(r) for r in document["regions"]]
        colliders = [AddCollider.model_validate(c) for c in document["colliders"]]
        story = document.get("story")
        board = None if story is None else Storyboard.model_validate(stored_storyboard(story))
        tombstones, next_instance_id = frozenset(document["gone"]), document["next_instance_id"]
    except (CodecError, KeyError, TypeError, ValueError) as error:
        raise EditError(
            ErrorCode.INVALID_OPERATION,
            f"these bytes hold no state: {error}",
            hint="replay the whole log instead",
        ) from error
    return replace(
        initial,
        objects=MappingProxyType(dict(initial.objects) | {o.object_id: o for o in found}),
        next_instance_id=next_instance_id,
        clock=(first, last),
        regions=MappingProxyType({str(r.region_id): r for r in regions}),
        colliders=MappingProxyType({str(c.collider_id): c for c in colliders}),
        tombstones=tombstones,
        storyboard=board,
    )


def _packed_object(subject: ObjectState) -> dict[str, Any]:
    driver = {"driver": subject.driver.model_dump(mode="json")} if subject.driver else {}
    gait = {"gait": subject.gait.model_dump(mode="json")} if subject.gait else {}
    return (
        driver
        | gait
        | {
            "object_id": subject.object_id,
            "source_id": subject.source_id,
            "category": subject.category,
            "size": list(subject.size),
            "scale": list(subject.scale),
            "times_us": subject.trajectory.times_us,
            "positions": subject.trajectory.positions,
            "quaternions": subject.trajectory.quaternions,
            "instance_id": subject.instance_id,
            "deleted": subject.deleted,
            "asset_id": subject.asset.asset_id if subject.asset else None,
            "physics": subject.physics.model_dump(mode="json") if subject.physics else None,
            "velocity": subject.velocity.model_dump(mode="json") if subject.velocity else None,
            "placed": subject.edited,
        }
    )


def _unpacked_object(packed: dict[str, Any], assets: AssetLookup | None) -> ObjectState:
    asset_id = packed["asset_id"]
    asset = assets(asset_id) if assets and asset_id is not None else None
    if asset is None and asset_id is not None:
        raise EditError(
            ErrorCode.UNKNOWN_ASSET,
            f"there is no asset {asset_id!r} in the library",
            hint="put it back",
        )
    physics, velocity = packed["physics"], packed["velocity"]
    length, width, height = packed["size"]
    x, y, z = packed["scale"]
    return ObjectState(
        object_id=packed["object_id"],
        source_id=packed["source_id"],
        category=packed["category"],
        size=(length, width, height),
        scale=(x, y, z),
        trajectory=Trajectory(packed["times_us"], packed["positions"], packed["quaternions"]),
        instance_id=packed["instance_id"],
        deleted=packed["deleted"],
        asset=asset,
        physics=SetPhysics.model_validate(physics) if physics else None,
        velocity=SetVelocity.model_validate(velocity) if velocity else None,
        gait=SetGait.model_validate(packed["gait"]) if "gait" in packed else None,
        edited=packed["placed"],
        driver=_DRIVER.validate_python(packed["driver"]) if "driver" in packed else None,
    )
