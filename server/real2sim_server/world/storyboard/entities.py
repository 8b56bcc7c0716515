"""Entities of a storyboard as objects of a world."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from real2sim_proto import ErrorCode
from real2sim_proto.storyboard import Entity

from ...edit import ObjectState, ScenarioState
from ...edit.compose import figure_of
from ...scene import Scene, Trajectory
from ...scene.scene import MAX_OBJECTS
from ..ego.box import REAR_OVERHANG
from ..errors import WorldError

BOXES = {
    "car": ((4.6, 1.85, 1.5), 1.35),
    "van": ((5.2, 2.0, 2.0), 1.5),
    "truck": ((8.0, 2.5, 3.2), 2.5),
    "bus": ((11.0, 2.5, 3.2), 3.0),
    "motorcycle": ((2.1, 0.8, 1.6), 0.0),
    "cyclist": ((1.8, 0.6, 1.8), 0.0),
    "pedestrian": ((0.5, 0.6, 1.8), 0.0),
    "animal": ((0.9, 0.3, 0.7), 0.0),
}
"""Size [m] of a category, and how far ahead of the reference point its middle is [m]."""

OTHER = ((1.0, 1.0, 1.0), 0.0)

ALIKE = (
    frozenset({"car", "vehicle", "van", "truck", "bus"}),
    frozenset({"motorcycle", "cyclist", "bicycle"}),
    frozenset({"pedestrian", "person", "animal"}),
)
"""Categories that may lend each other their looks."""

Vector = tuple[float, float, float]


def box_of(entity: Entity, subject: ObjectState | None, ego_size: Vector) -> tuple[Vector, Vector]:
    """Size of an entity's box and where its middle is from the reference point [m]: as it says, of
    the object or ego that it is, or by its category."""
    if entity.kind == "ego":
        return ego_size, (ego_size[0] / 2 - REAR_OVERHANG, 0.0, ego_size[2] / 2)
    if entity.box is not None:
        length, width, height = (float(v) for v in entity.box.size)
        x, y, z = (float(v) for v in entity.box.centre)
        return (length, width, height), (x, y, z)
    if entity.kind == "object" and subject is not None:
        size = subject.scaled_size
        return size, (0.0, 0.0, size[2] / 2)
    size, ahead = BOXES.get(entity.category, OTHER)
    return size, (ahead, 0.0, size[2] / 2)


def own_centre(ego: Entity, ego_size: Vector) -> Vector | None:
    """Where the middle of the ego's box is from its reference point [m], as the storyboard says of
    a vehicle of that size; None: it speaks of another vehicle, or of none."""
    if ego.box is None or not np.allclose([float(v) for v in ego.box.size], ego_size, atol=1e-6):
        return None
    x, y, z = (float(v) for v in ego.box.centre)
    return x, y, z


def subjects_of(
    entities: Iterable[Entity], state: ScenarioState, scene: Scene
) -> dict[str, ObjectState]:
    """The object of each entity but the ego, by name; new ones look like objects of ``scene``.

    Raises:
        WorldError: UNKNOWN_OBJECT for an object or look that the world lacks, UNKNOWN_ASSET,
            INVALID_REQUEST where nobody could be looked like, or an id is taken.
    """
    found, number = dict[str, ObjectState](), MAX_OBJECTS
    for entity in entities:
        if entity.kind == "ego":
            continue
        if entity.kind == "object":
            found[entity.name] = _known(state, str(entity.object_id), f"entity {entity.name!r}")
            continue
        found[entity.name] = _new(entity, state, scene, number)
        number -= 1
    ids = [subject.object_id for subject in found.values()]
    if twice := sorted({i for i in ids if ids.count(i) > 1}):
        raise WorldError(
            ErrorCode.INVALID_REQUEST,
            f"two entities of the storyboard are the object {twice[0]!r}",
            hint="name each object once, and entities unlike the objects of the scene",
        )
    return found


def object_ids_of(name: str) -> tuple[str, str]:
    """The id of the object of a new entity, and the one where that is taken."""
    object_id = "".join(c if c.isalnum() or c in "_.-" else "_" for c in name)[:80]
    return object_id, f"{object_id[:72]}.story"


def _known(state: ScenarioState, object_id: str, who: str) -> ObjectState:
    known = {o.object_id: o for o in state.visible}
    if object_id not in known:
        raise WorldError(
            ErrorCode.UNKNOWN_OBJECT,
            f"{who} of the storyboard is {object_id!r}, which is no object of this world",
            hint=f"objects of this world: {', '.join(known) or 'none'}",
        )
    return known[object_id]


def _new(entity: Entity, state: ScenarioState, scene: Scene, instance_id: int) -> ObjectState:
    size, _ = box_of(entity, None, (1.0, 1.0, 1.0))
    object_id, else_id = object_ids_of(entity.name)
    if state.has_id(object_id):
        object_id = else_id
    here = Trajectory(np.zeros(1, np.int64), np.zeros((1, 3)), np.array([[1.0, 0.0, 0.0, 0.0]]))
    common = {
        "object_id": object_id,
        "category": entity.category,
        "instance_id": instance_id,
        "trajectory": here,
        "velocity": None,
        "edited": True,
    }
    if entity.asset_id is not None:
        asset = state.assets(entity.asset_id) if state.assets else None
        if asset is None:
            raise WorldError(
                ErrorCode.UNKNOWN_ASSET,
                f"entity {entity.name!r} shows asset {entity.asset_id!r}, which is not in the "
                "library",
                hint="GET /v1/assets lists them; POST /v1/assets adds one",
            )
        fitted = _fitted(size, asset.size, walks=asset.figure is not None)
        return ObjectState(source_id="", asset=asset, **fitted, **common)  # type: ignore[arg-type]
    look = _look(entity, state, size)
    fitted = _fitted(size, look.size, walks=figure_of(scene, look) is not None)
    return replace(look, **fitted, **common)  # type: ignore[arg-type]


def _look(entity: Entity, state: ScenarioState, size: Vector) -> ObjectState:
    """Whom it looks like: who is named, else who is most like it in category, then in size."""
    if entity.look is not None:
        return _known(state, entity.look, f"the look of {entity.name!r}")
    candidates = list(state.visible)
    if not candidates:
        raise WorldError(
            ErrorCode.INVALID_REQUEST,
            f"entity {entity.name!r} has nobody to look like: the scene has no object",
            hint="name an asset of the library in `asset_id`",
        )
    group = next((g for g in ALIKE if entity.category in g), frozenset({entity.category}))

    def unlike(subject: ObjectState) -> tuple[bool, bool, float, str]:
        ratios = [a / b for a, b in zip(size, subject.size, strict=True)]
        stretch = sum(math.log(r) ** 2 for r in ratios)
        same = subject.category == entity.category
        return subject.category not in group, not same, stretch, subject.object_id

    return min(candidates, key=unlike)


def _fitted(size: Vector, of: Vector, *, walks: bool) -> dict[str, Vector]:
    """Size before its scale, and scale, of whoever has the box ``size`` and looks like something of
    size ``of``: stretched to it, or as a person only made taller."""
    if not walks:
        return {"size": of, "scale": (size[0] / of[0], size[1] / of[1], size[2] / of[2])}
    scale = size[2] / of[2]
    length, width, height = (edge / scale for edge in size)
    return {"size": (length, width, height), "scale": (scale, scale, scale)}
