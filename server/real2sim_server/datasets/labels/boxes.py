"""Boxes and future trajectories of objects."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...edit import ObjectState, PlacedObjects
from ...geometry import (
    Float,
    apply_transform,
    box_corners,
    invert_transform,
    matrix_to_quaternion,
    quaternion_yaw,
)
from ...scene import Camera
from ...world.path import LoggedPath, command_ahead, route_ahead
from ..drive import Drive

# 3D boxes at an instant, their projections, and simulated detections.

NEAR = 0.1
"""Boxes are cut at this depth in front of a camera [m]."""

EDGES = (
    (0, 1), (2, 3), (4, 5), (6, 7), (0, 2), (1, 3), (4, 6), (5, 7), (0, 4), (1, 5), (2, 6), (3, 7),
)  # fmt: skip
"""Edges between corners in the order of ``box_corners``."""

FACES = (((0, 2, 6, 4), (1, 3, 7, 5)), ((0, 1, 5, 4), (2, 3, 7, 6)), ((0, 1, 3, 2), (4, 5, 7, 6)))
"""Corners around the faces at the negative and the positive end of x, y and z."""

Box2D = tuple[float, float, float, float]
"""Left, top, right, bottom [px]; pixel (0, 0) extends from 0 to 1."""


@dataclass(frozen=True, eq=False)
class ObjectBox:
    """One object at an instant.

    Attributes:
        object_id: unique in the drive.
        category: as in the scene.
        instance_id: id of its pixels in instance images.
        size: (length, width, height) along its x, y, z [m].
        T_world_object: [4, 4], origin at the box centre.
        velocity: [3] in the world [m/s].
    """

    object_id: str
    category: str
    instance_id: int
    size: tuple[float, float, float]
    T_world_object: Float
    velocity: Float


def boxes_at(placed: PlacedObjects[ObjectState]) -> list[ObjectBox]:
    """Boxes of all existing objects, in order."""
    return [
        ObjectBox(
            object_id=subject.object_id,
            category=subject.category,
            instance_id=subject.instance_id,
            size=(float(size[0]), float(size[1]), float(size[2])),
            T_world_object=transform,
            velocity=velocity,
        )
        for subject, size, transform, velocity in zip(
            placed.objects, placed.sizes, placed.transforms, placed.velocities, strict=True
        )
    ]


def projected_box(
    T_world_object: Float, size: Sequence[float], camera: Camera, T_world_camera: Float
) -> Box2D | None:
    """Bounding box [px] of a projected 3D box, not clipped to the image; None if it is completely
    behind the near plane.
    """
    T_camera_object = invert_transform(T_world_camera) @ T_world_object
    corners = box_corners(T_camera_object, size)
    depths = corners[:, 2].tolist()
    if max(depths) < NEAR:
        return None
    seen = corners if min(depths) >= NEAR else _ahead(corners)
    points = seen @ camera.K.T
    pixels = points[:, :2] / points[:, 2:]
    left, top = pixels.min(axis=0).tolist()
    right, bottom = pixels.max(axis=0).tolist()
    return (left, top, right, bottom)


def _ahead(corners: Float) -> Float:
    """Corners in front of the near plane, and intersections of edges with it."""
    seen = [corner for corner in corners if corner[2] >= NEAR]
    for i, j in EDGES:
        a, b = corners[i], corners[j]
        if (a[2] < NEAR) != (b[2] < NEAR):
            seen.append(a + (b - a) * (NEAR - a[2]) / (b[2] - a[2]))
    return np.array(seen)


def cut_at_border(box: Box2D, width: int, height: int) -> Box2D | None:
    """The part of a box inside an image, or None."""
    left, top, right, bottom = box
    cut = (max(left, 0.0), max(top, 0.0), min(right, float(width)), min(bottom, float(height)))
    return cut if cut[0] < cut[2] and cut[1] < cut[3] else None


def truncation(
    T_world_object: Float, size: Sequence[float], camera: Camera, T_world_camera: Float
) -> float:
    """Share of a 3D box outside the image, 0 to 1: of the area of the faces that face the camera.

    What is behind the camera is outside; so is a box around the camera.
    """
    T_camera_object = invert_transform(T_world_camera) @ T_world_object
    corners = box_corners(T_camera_object, size)
    eye = invert_transform(T_camera_object)[:3, 3]
    x, y, z = camera.K
    # Planes from the camera's position through the image borders, positive towards the image. All
    # four are positive only in front of the camera.
    borders = (x, camera.width * z - x, y, camera.height * z - y)
    if (corners @ np.array(borders).T >= 0).all():
        return 0.0
    whole = inside = 0.0
    for axis, ends in enumerate(FACES):
        if abs(eye[axis]) > size[axis] / 2:
            face = corners[list(ends[int(eye[axis] > 0)])]
            whole += _area(face)
            for border in borders:
                face = _cut(face, border)
            inside += _area(face)
    return min(max(1 - inside / whole, 0.0), 1.0) if whole else 1.0


def _cut(polygon: Float, plane: Float) -> Float:
    """The part [M, 3] of a convex polygon [N, 3] on the positive side of a plane through 0."""
    sides = (polygon @ plane).tolist()
    kept = []
    for k, side in enumerate(sides):
        if (side < 0) != (sides[k - 1] < 0):
            kept.append(polygon[k] + (polygon[k - 1] - polygon[k]) * side / (side - sides[k - 1]))
        if side >= 0:
            kept.append(polygon[k])
    return np.array(kept).reshape(-1, 3)


def _area(polygon: Float) -> float:
    """Area of a flat polygon [N, 3]."""
    if len(polygon) < 3:
        return 0.0
    spokes = polygon[1:] - polygon[0]
    return float(np.linalg.norm(np.cross(spokes[:-1], spokes[1:]).sum(axis=0))) / 2


def in_frame(box: ObjectBox, T_frame_world: Float) -> tuple[Float, Float]:
    """``T_frame_object`` [4, 4] and the velocity [3] along the axes of another frame [m/s]."""
    velocity = apply_transform(T_frame_world, np.stack([box.velocity, np.zeros(3)]))
    return T_frame_world @ box.T_world_object, velocity[0] - velocity[1]


# --- Noise ---------------------------------------------------------------------------------------

# Jittered, missed and false boxes.

CAR_SIZE = (4.5, 1.8, 1.5)
REACH = 60.0
"""Maximum distance of false detections from the ego [m]."""


@dataclass(frozen=True)
class BoxNoise:
    """Error model of a detector.

    Attributes:
        position: standard deviation of each coordinate of the centre [m].
        size: standard deviation of each edge, relative to its length.
        heading: [rad].
        missed: share of missed boxes.
        false: mean number of false positives per frame.
    """

    position: float = 0.0
    size: float = 0.0
    heading: float = 0.0
    missed: float = 0.0
    false: float = 0.0


def noisy_boxes(
    boxes: Sequence[ObjectBox], in_ego: Sequence[Float], noise: BoxNoise, seed: Sequence[int]
) -> list[dict[str, Any]]:
    """Detections of a frame: category, ``T_ego_object``, size, score and object id (None for false
    detections).

    Args:
        boxes: boxes of the frame.
        in_ego: their poses [4, 4] in the ego frame.
        noise: error model of the detector.
        seed: seed of the noise.
    """
    rng = np.random.default_rng(list(seed))
    found = []
    for box, pose in zip(boxes, in_ego, strict=True):
        missed, score = rng.random() < noise.missed, rng.beta(8, 2)
        shift, stretch, turn = rng.standard_normal(3), rng.standard_normal(3), rng.standard_normal()
        if missed:
            continue
        moved = pose @ _about_z(turn * noise.heading)
        moved[:3, 3] += shift * noise.position
        size = np.array(box.size) * np.clip(1 + stretch * noise.size, 0.2, 5.0)
        found.append(_detection(box.object_id, box.category, moved, size, score))
    categories = sorted({box.category for box in boxes}) or ["car"]
    for _ in range(int(rng.poisson(noise.false))):
        category = categories[int(rng.integers(len(categories)))]
        sizes = [box.size for box in boxes if box.category == category] or [CAR_SIZE]
        size = np.array(sizes[0])
        pose = _about_z(rng.uniform(-math.pi, math.pi))
        away, around = REACH * math.sqrt(rng.random()), rng.uniform(-math.pi, math.pi)
        pose[:3, 3] = away * math.cos(around), away * math.sin(around), size[2] / 2
        found.append(_detection(None, category, pose, size, rng.beta(2, 5)))
    return found


def _detection(
    object_id: str | None, category: str, pose: Float, size: Float, score: float
) -> dict[str, Any]:
    return {
        "object_id": object_id,
        "category": category,
        "T_ego_object": pose.tolist(),
        "size": size.tolist(),
        "score": float(score),
    }


def _about_z(angle: float) -> Float:
    matrix = np.eye(4)
    matrix[0, 0] = matrix[1, 1] = math.cos(angle)
    matrix[1, 0] = math.sin(angle)
    matrix[0, 1] = -matrix[1, 0]
    return matrix


# --- Futures --------------------------------------------------------------------------------------

# Targets of prediction and planning.

STEP_US = 500_000
"""Time step of futures [us]."""
AGENT_STEPS, EGO_STEPS = 16, 8
"""Number of time steps: 8 s for every agent, 4 s for the ego."""


def futures_at(drive: Drive, t_us: int, object_ids: Sequence[str]) -> dict[str, list[list[float]]]:
    """The next 8 s of each object at 2 Hz, by id: rows (seconds, x, y, z, heading) in the world,
    while the object exists and until the end of the drive.
    """
    futures: dict[str, list[list[float]]] = {object_id: [] for object_id in object_ids}
    for step in range(1, AGENT_STEPS + 1):
        then = t_us + step * STEP_US
        if then > drive.span[1]:
            break
        placed = drive.placed_at(then)
        for object_id, row in _rows(placed, step).items():
            if object_id in futures and len(futures[object_id]) == step - 1:
                futures[object_id].append(row)
    return futures


def _rows(placed: PlacedObjects[ObjectState], step: int) -> dict[str, list[float]]:
    seconds = step * STEP_US * 1e-6
    yaws = quaternion_yaw(placed.quaternions)
    return {
        subject.object_id: [seconds, *position.tolist(), float(yaw)]
        for subject, position, yaw in zip(placed.objects, placed.positions, yaws, strict=True)
    }


def ego_future(drive: Drive, t_us: int) -> list[list[float]]:
    """The ego's next 4 s at 2 Hz: rows (seconds, x, y, heading) in its own frame at ``t_us``, until
    the end of the drive.
    """
    to_ego = invert_transform(drive.ego_at(t_us))
    rows = []
    for step in range(1, EGO_STEPS + 1):
        then = t_us + step * STEP_US
        if then > drive.span[1]:
            break
        pose: Float = to_ego @ drive.ego_at(then)
        yaw = float(quaternion_yaw(matrix_to_quaternion(pose[:3, :3])))
        rows.append([step * STEP_US * 1e-6, float(pose[0, 3]), float(pose[1, 3]), yaw])
    return rows


def ego_state(drive: Drive, path: LoggedPath, t_us: int) -> dict[str, Any]:
    """Planner input at ``t_us``, as in a session: ``speed`` [m/s], ``command``, and ``route``, 20
    points 2 m apart in the ego's frame [m] along ``path``, the recorded drive.
    """
    pose = drive.ego_at(t_us)
    x, y = pose[:2, 3].tolist()
    yaw = float(quaternion_yaw(matrix_to_quaternion(pose[:3, :3])))
    s = path.nearest(x, y).s
    return {
        "speed": drive.ego_speed_at(t_us),
        "command": command_ahead(path, s),
        "route": route_ahead(path, s, x, y, yaw).tolist(),
    }
