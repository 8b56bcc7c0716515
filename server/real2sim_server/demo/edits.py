"""The demo's edits: one car moved, another duplicated, both where they overlap nothing."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from real2sim_proto.operations import Duplicate, Operation, Translate

from ..geometry.box import box_corners
from ..geometry.transform import transform_from

if TYPE_CHECKING:
    from real2sim_proto.scenes import ObjectInfo, SceneInfo

AHEAD = (6.0, 45.0)
"""How far ahead of the start a car must be to be edited [m]; there the camera sees it well."""

WIDTH = 960


@dataclass(frozen=True)
class StreetEdits:
    """What was edited, and how it looks.

    Attributes:
        moved, duplicated: ids of the two cars that were edited.
        before, after: RGB uint8 [H, W, 3] of the same camera.
        logged: [L, 2] path of the recording vehicle [m].
        footprints: (id, corners [4, 2] at the start [m], whether it was edited) of every object.
        gaussians: of the whole scene.
    """

    moved: str
    duplicated: str
    before: NDArray[np.uint8]
    after: NDArray[np.uint8]
    logged: NDArray[np.float64]
    footprints: list[tuple[str, NDArray[np.float64], bool]]
    gaussians: int


def edit_street(scenario: Any, scene: SceneInfo, *, camera: str) -> StreetEdits:
    """Move one standing car and duplicate another, with the pictures before and after."""
    before = scenario.preview(camera=camera, width=WIDTH, codec="jpeg").array
    candidates = _standing_cars(scenario.info.objects, scene)
    moved = _apply_first_without_overlap(scenario, _moves(candidates))
    others = [car for car in candidates if car.object_id != moved.object_id]
    copied = _apply_first_without_overlap(scenario, _copies(others or candidates))
    after = scenario.preview(camera=camera, width=WIDTH, codec="jpeg").array
    objects = scenario.refresh().info.objects
    original = {info.object_id for info in scene.objects}
    edited = {moved.object_id} | {o.object_id for o in objects if o.object_id not in original}
    return StreetEdits(
        moved=moved.object_id,
        duplicated=copied.object_id,
        before=before,
        after=after,
        logged=np.array(scene.ego.positions if scene.ego else [])[:, :2],
        footprints=[(o.object_id, _footprint(o), o.object_id in edited) for o in objects],
        gaussians=scene.gaussians,
    )


def _standing_cars(objects: Sequence[ObjectInfo], scene: SceneInfo) -> list[ObjectInfo]:
    """Standing cars ahead of the start, nearest first."""
    start = np.array(scene.ego.positions[0]) if scene.ego else np.zeros(3)
    found = []
    for info in objects:
        if info.trajectory is None or info.trajectory.times_us[0] > scene.start_us:
            continue
        places = np.array(info.trajectory.positions)
        ahead = places[0, 0] - start[0]
        if np.ptp(places, axis=0).max() < 0.3 and AHEAD[0] < ahead < AHEAD[1]:
            found.append((ahead, info))
    return [info for _, info in sorted(found, key=lambda pair: pair[0])]


def _moves(cars: Sequence[ObjectInfo]) -> Iterator[Operation]:
    """A car out of its parking space into the lane beside it, facing as before."""
    for car in cars:
        position = np.array(car.trajectory.positions[0]) if car.trajectory else np.zeros(3)
        inward = -np.sign(position[1]) * (car.size[1] + 0.9)
        for along in (0.0, 3.0, -3.0, 6.0):
            yield Translate(object_id=car.object_id, x=along, y=float(inward), frame="world")


def _copies(cars: Sequence[ObjectInfo]) -> Iterator[Operation]:
    """A second car one or two lengths before or behind."""
    for car in cars:
        for lengths in (1.25, -1.25, 2.5, -2.5):
            yield Duplicate(object_id=car.object_id, x=lengths * car.size[0], frame="object")


def _apply_first_without_overlap(scenario: Any, operations: Iterator[Operation]) -> Any:
    """Try operations as dry runs; apply the first that gets no warning, else the very first."""
    first: Operation | None = None
    for operation in operations:
        first = first or operation
        if not scenario.apply([operation], dry_run=True).warnings:
            first = operation
            break
    if first is None:
        raise RuntimeError("the demo street has no standing car ahead of the start")
    scenario.apply([first])
    return first


def _footprint(info: ObjectInfo) -> NDArray[np.float64]:
    assert info.trajectory is not None
    pose = transform_from(info.trajectory.positions[0], info.trajectory.quaternions[0])
    corners = box_corners(pose, info.size)
    return corners[[0, 1, 3, 2], :2]
