"""A bicycle and its rider: wheels and cranks turn with the distance, and the limbs follow."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..geometry import Float, matrix_to_quaternion
from .gait import GRAVITY, leg_lengths, put_leg, put_spine
from .model import JOINTS, LATERAL, Body, Pose, about, aim, bend, chain_transforms, joint_positions

FRAME, TYRE, RIM, CRANK, SADDLE = range(5)
SURFACES = ("bicycle_frame", "tyre", "rim", "crank", "saddle")
"""Surfaces of a bicycle, by their index in ``Bicycle.surfaces``."""

_RIGID, _REAR, _FRONT, _CRANKS, _PEDAL_L, _PEDAL_R = range(6)
GEAR = 2.4
"""Turns of the wheels per turn of the cranks."""

# Dimensions of an adult's city bicycle, (x, z) from the ground under its middle [m].
REAR_AXLE, FRONT_AXLE = (-0.51, 0.34), (0.54, 0.34)
BOTTOM, HEAD_LOW, HEAD_HIGH, STEM = (-0.08, 0.29), (0.36, 0.72), (0.31, 0.88), (0.28, 1.0)
GRIP = (0.2, 0.28, 1.03)
WHEEL_RADIUS, CRANK_LENGTH, PEDAL_OFFSET = 0.34, 0.165, 0.125
SEAT_X = -0.27
ADULT_LEG = 0.87
"""Leg length of a rider whom these dimensions fit [m]."""


@dataclass(frozen=True, eq=False)
class Bicycle:
    """A bicycle that fits its rider.

    Attributes:
        scale: factor on all dimensions.
        saddle: height of the saddle's top [m].
        vertices: [V, 3] with the left crank forward, frame with the origin on the ground under
            the middle, x forward, z up [m].
        triangles: [T, 3].
        surfaces: [T] index into ``SURFACES``.
        moves: [V] moving part of each vertex.
    """

    scale: float
    saddle: float
    vertices: Float
    triangles: NDArray[np.int64]
    surfaces: NDArray[np.int64]
    moves: NDArray[np.int64]

    @property
    def wheel_radius(self) -> float:
        """Radius of the wheels [m]."""
        return WHEEL_RADIUS * self.scale

    def crank_angle(self, distance: ArrayLike) -> Float:
        """Angle of the cranks [T] after distances [T] [m]; they turn forward, about y [rad]."""
        return np.asarray(distance, dtype=np.float64) / (self.wheel_radius * GEAR)

    def placed(self, distance: ArrayLike, roll: ArrayLike) -> Float:
        """Vertices [T, V, 3] after distances [T] [m], leaning to the left by ``roll`` [T] [rad]."""
        distance = np.atleast_1d(np.asarray(distance, dtype=np.float64))
        turned = distance / self.wheel_radius
        crank = self.crank_angle(distance)
        out = np.broadcast_to(self.vertices, (len(distance), *self.vertices.shape)).copy()
        for part, axle, angle in (
            (_REAR, REAR_AXLE, turned),
            (_FRONT, FRONT_AXLE, turned),
            (_CRANKS, BOTTOM, crank),
        ):
            own, centre = self.moves == part, _point(axle) * self.scale
            local = self.vertices[own] - centre
            out[:, own] = centre + local @ np.swapaxes(about(LATERAL, angle), -1, -2)
        for part, side in ((_PEDAL_L, 0), (_PEDAL_R, 1)):
            own = self.moves == part
            at = self.pedal(distance, side) - self.pedal(np.zeros(1), side)
            out[:, own] = self.vertices[own] + at[:, None]
        leaned: Float = out @ np.swapaxes(about([1, 0, 0], -np.asarray(roll)), -1, -2)
        return leaned

    def pedal(self, distance: ArrayLike, side: int) -> Float:
        """Centre of the left (0) or right (1) pedal [T, 3], without lean."""
        angle = self.crank_angle(distance) + np.pi * side
        x = np.cos(angle) * CRANK_LENGTH
        z = -np.sin(angle) * CRANK_LENGTH
        y = np.full_like(x, PEDAL_OFFSET * (1 - 2 * side))
        return (_point(BOTTOM) + np.stack([x, y, z], axis=-1)) * self.scale


@dataclass(frozen=True, eq=False)
class Ride:
    """A rider on a bicycle along a path.

    Attributes:
        body: the rider.
        bicycle: the rider's bicycle.
        times: [N] times of the path [s].
        distance: [N] covered since its start [m].
        roll: [N] lean to the left [rad].
    """

    body: Body
    bicycle: Bicycle
    times: Float
    distance: Float
    roll: Float

    def at(self, times: ArrayLike) -> tuple[Float, Float]:
        """Distance [T] and roll [T] at times [T] [s]; the path continues straight at its ends."""
        times = np.atleast_1d(np.asarray(times, dtype=np.float64))
        distance = np.interp(times, self.times, self.distance)
        for end, beside in ((0, 1), (-1, -2)):
            if len(self.times) > 1:
                span = self.times[end] - self.times[beside]
                pace = (self.distance[end] - self.distance[beside]) / span
                beyond = (times - self.times[end]) * (1 if end else -1) > 0
                distance = np.where(
                    beyond, self.distance[end] + pace * (times - self.times[end]), distance
                )
        return distance, np.interp(times, self.times, self.roll)

    def pose(self, times: ArrayLike) -> Pose:
        """Poses of the rider at times [T] [s], in the bicycle's frame."""
        distance, roll = self.at(times)
        return self.seat.pose(distance, roll)

    def bicycle_vertices(self, times: ArrayLike) -> Float:
        """Vertices [T, V, 3] of the bicycle at times [T] [s]."""
        return self.bicycle.placed(*self.at(times))

    @cached_property
    def seat(self) -> Seat:
        """The rider's seat on the bicycle."""
        return seat_rider(self.body)


def plan_ride(body: Body, times: ArrayLike, positions: ArrayLike, yaws: ArrayLike) -> Ride:
    """A ride along positions [N, 3] of the bicycle's origin with headings [N] at times [N].

    Leaning into a bend balances the centrifugal force: tan(roll) = v yaw' / g.

    Raises:
        ValueError: times that do not increase.
    """
    times = np.asarray(times, dtype=np.float64)
    positions = np.asarray(positions, dtype=np.float64)
    yaws = np.unwrap(np.asarray(yaws, dtype=np.float64))
    if len(times) == 0 or (np.diff(times) <= 0).any():
        raise ValueError("times must rise")
    moved = np.linalg.norm(np.diff(positions[:, :2], axis=0), axis=1)
    distance = np.concatenate([[0.0], np.cumsum(moved)])
    roll = np.zeros(len(times))
    if len(times) > 2:
        speed, turn = np.gradient(distance, times), np.gradient(yaws, times)
        roll = np.arctan(speed * turn / GRAVITY)
    seat = seat_rider(body)
    return Ride(body, build_bicycle(seat.scale, seat.saddle), times, distance, roll)


@dataclass(frozen=True, eq=False)
class Seat:
    """Seat of a rider: pelvis position [3], lean of pelvis and chest [rad], saddle height [m]."""

    body: Body
    scale: float
    pelvis: Float
    pelvis_lean: float
    chest_lean: float
    saddle: float

    def pose(self, distance: Float, roll: Float) -> Pose:
        """Poses after distances [T] [m], leaning to the left by ``roll`` [T]."""
        count = len(distance)
        local = np.broadcast_to(np.eye(3), (count, len(JOINTS), 3, 3)).copy()
        pelvis_turn = np.broadcast_to(about(LATERAL, self.pelvis_lean), (count, 3, 3))
        local[:, 0] = pelvis_turn
        for index, side in enumerate("lr"):
            ankle, foot = self._on_pedal(distance, index)
            hip_bone = self.body.joint(f"thigh_{side}") - self.body.joint("pelvis")
            put_leg(self.body, local, side, self.pelvis + pelvis_turn @ hip_bone, ankle, foot)
        chest = np.broadcast_to(about(LATERAL, self.chest_lean), (count, 3, 3))
        head = np.broadcast_to(about(LATERAL, 0.25 * self.chest_lean), (count, 3, 3))
        put_spine(local, pelvis_turn, chest, head)
        self._put_arms(local, chest)
        lean = about([1, 0, 0], -roll)
        local[:, 0] = lean @ local[:, 0]
        return Pose(matrix_to_quaternion(local), (lean @ self.pelvis[:, None])[..., 0])

    def _on_pedal(self, distance: Float, index: int) -> tuple[Float, Float]:
        """Ankles [T, 3] and rotations [T, 3, 3] of a foot with its ball over the pedal."""
        side = "lr"[index]
        bicycle = _crankset(self.scale)
        angle = bicycle.crank_angle(distance) + np.pi * index
        # The heel is lowest with the foot in front and highest behind.
        foot = about(LATERAL, np.radians(10) - np.radians(12) * np.cos(angle))
        ankle, ball = self.body.joint(f"foot_{side}"), self.body.joint(f"ball_{side}")
        over = np.array([0.0, 0.0, ball[2] + 0.012 * self.scale])
        pedal = bicycle.pedal(distance, index)
        return pedal + over + (foot @ (ankle - ball)[:, None])[..., 0], foot

    def _put_arms(self, local: Float, chest: Float) -> None:
        joints = joint_positions(self.body, chain_transforms(self.body, local, self.pelvis))
        for side, sign in (("l", 1.0), ("r", -1.0)):
            names = [f"{name}_{side}" for name in ("upper_arm", "forearm", "hand")]
            rest = [self.body.joint(name) for name in names]
            shoulder = joints[:, JOINTS.index(names[0])]
            wrist = np.broadcast_to(_wrist(self.scale, sign), shoulder.shape)
            upper, lower = np.linalg.norm(rest[1] - rest[0]), np.linalg.norm(rest[2] - rest[1])
            aside = np.broadcast_to(np.array([-0.3, 0.5 * sign, -1.0]), shoulder.shape)
            elbow = bend(shoulder, wrist, float(upper), float(lower), aside)
            first = aim(rest[1] - rest[0], elbow - shoulder)
            second = aim((first @ (rest[2] - rest[1])[:, None])[..., 0], wrist - elbow) @ first
            local[:, JOINTS.index(names[0])] = np.swapaxes(chest, -1, -2) @ first
            local[:, JOINTS.index(names[1])] = np.swapaxes(first, -1, -2) @ second


def seat_rider(body: Body) -> Seat:
    """Seat a body on a fitting bicycle: legs almost straight at the bottom, hands on the grips."""
    # Frames for tall riders are only slightly longer, but the saddle is higher.
    scale = min(body.leg_length / ADULT_LEG, 1.02)
    pelvis_lean = np.radians(12)
    trial = Seat(body, scale, np.array([SEAT_X * scale, 0, 1.0]), pelvis_lean, 0.0, 0.0)
    ankle = trial._on_pedal(np.linspace(0, 2 * np.pi, 73) * WHEEL_RADIUS * scale * GEAR, 0)[0]
    turned = about(LATERAL, pelvis_lean)
    hip = turned @ (body.joint("thigh_l") - body.joint("pelvis")) + [SEAT_X * scale, 0, 0]
    full = 0.965 * sum(leg_lengths(body, "l"))
    across = np.linalg.norm((ankle - hip)[:, :2], axis=1)
    height = float((ankle[:, 2] + np.sqrt(full**2 - across**2) - hip[2]).min())
    crotch = body.joint("pelvis")[2] - _crotch(body)
    pelvis = np.array([SEAT_X * scale, 0.0, height])
    lean = _reaching_lean(body, pelvis, turned, scale)
    return Seat(body, scale, pelvis, float(pelvis_lean), lean, height - crotch + 0.02 * scale)


def _crotch(body: Body) -> float:
    """Height of the lowest point between the legs [m]."""
    hips = body.vertices[body.model.parts == body.model.part_names.index("hips")]
    middle = np.abs(hips[:, 1]) < 0.02 * body.height
    return float(hips[middle, 2].min())


def _reaching_lean(body: Body, pelvis: Float, turned: Float, scale: float) -> float:
    """Minimum lean of the chest at which bent arms reach the grips [rad]."""
    bones = [body.joint(f"{name}_l") for name in ("upper_arm", "forearm", "hand")]
    reach = 0.95 * sum(np.linalg.norm(b - a) for a, b in pairwise(bones))
    leans = np.radians(np.arange(5.0, 71.0))
    local = np.broadcast_to(np.eye(3), (len(leans), len(JOINTS), 3, 3)).copy()
    local[:, 0] = turned
    put_spine(local, local[:, 0].copy(), about(LATERAL, leans), about(LATERAL, leans))
    joints = joint_positions(body, chain_transforms(body, local, pelvis))
    away = np.linalg.norm(joints[:, JOINTS.index("upper_arm_l")] - _wrist(scale, 1.0), axis=1)
    within = np.flatnonzero(away <= reach)
    return float(leans[within[0]] if len(within) else leans[away.argmin()])


def _wrist(scale: float, sign: float) -> Float:
    x, y, z = GRIP
    return np.array([x - 0.055, sign * y, z + 0.035]) * scale


def _point(xz: tuple[float, float], y: float = 0.0) -> Float:
    return np.array([xz[0], y, xz[1]])


def _crankset(scale: float) -> Bicycle:
    """A bicycle with only its drivetrain."""
    none = np.zeros(0, np.int64)
    return Bicycle(scale, 0.0, np.zeros((0, 3)), none.reshape(0, 3), none, none)


def build_bicycle(scale: float, saddle: float) -> Bicycle:
    """A bicycle with dimensions scaled by ``scale`` and the saddle's top at ``saddle`` [m]."""
    parts = _Parts()
    seat = (BOTTOM[0] + (SEAT_X - BOTTOM[0]) * 0.8, 0.72)
    top = (SEAT_X - 0.01, saddle / scale)
    for ends, radius in (
        ((BOTTOM, seat), 0.017), ((BOTTOM, HEAD_LOW), 0.021), ((seat, HEAD_HIGH), 0.017),
        ((HEAD_LOW, HEAD_HIGH), 0.022), ((HEAD_HIGH, STEM), 0.014), ((seat, top), 0.014),
    ):  # fmt: skip
        parts.tube([_point(e) for e in ends], radius, FRAME, _RIGID)
    for y in (-0.055, 0.055):
        parts.tube([_point(BOTTOM, 0.5 * y), _point(REAR_AXLE, y)], 0.011, FRAME, _RIGID)
        parts.tube([_point(seat, 0.4 * y), _point(REAR_AXLE, y)], 0.009, FRAME, _RIGID)
        parts.tube([_point(HEAD_LOW, y), _point(FRONT_AXLE, y)], 0.011, FRAME, _RIGID)
    x, y, z = GRIP
    bar = [[x, -y, z], [x + 0.1, -y, z], [STEM[0], 0, STEM[1]], [x + 0.1, y, z], [x, y, z]]
    parts.tube(np.array(bar), 0.013, FRAME, _RIGID)
    for side in (-y, y):
        parts.tube([[x - 0.02, side, z], [x + 0.1, side, z]], 0.018, SADDLE, _RIGID)
    parts.tube(
        [_point((top[0] - 0.13, top[1] - 0.03)), _point((top[0] + 0.15, top[1] - 0.03))],
        [0.05, 0.02], SADDLE, _RIGID, sides=8,
    )  # fmt: skip
    for axle, moves in ((REAR_AXLE, _REAR), (FRONT_AXLE, _FRONT)):
        parts.wheel(_point(axle), moves)
    for sign, pedal in ((1.0, _PEDAL_L), (-1.0, _PEDAL_R)):
        inner, outer = 0.06 * sign, PEDAL_OFFSET * sign
        end = (BOTTOM[0] + sign * CRANK_LENGTH, BOTTOM[1])
        parts.tube([_point(BOTTOM, inner), _point(end, inner)], 0.011, CRANK, _CRANKS)
        pin = [_point((end[0] + x, end[1]), outer) for x in (-0.045, 0.045)]
        parts.tube(pin, 0.02, CRANK, pedal, sides=4)
    parts.ring(_point(BOTTOM, -0.05), 0.09, 0.006, CRANK, _CRANKS)
    return parts.build(scale, saddle)


class _Parts:
    """Collects tubes and rings."""

    def __init__(self) -> None:
        self.vertices: list[Float] = []
        self.triangles: list[NDArray[np.int64]] = []
        self.surfaces: list[NDArray[np.int64]] = []
        self.moves: list[NDArray[np.int64]] = []
        self.count = 0

    def tube(
        self, path: ArrayLike, radius: ArrayLike, surface: int, moves: int, *, sides: int = 6
    ) -> None:
        """A tube along points, closed at its ends."""
        path = np.asarray(path, dtype=np.float64)
        along = np.gradient(path, axis=0)
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        away = np.where(np.abs(along[:, 1:2]) > 0.9, [[1.0, 0, 0]], [[0.0, 1, 0]])
        first = np.cross(along, away)
        first /= np.linalg.norm(first, axis=1, keepdims=True)
        second = np.cross(along, first)
        angle = np.arange(sides) * 2 * np.pi / sides
        circle = first[:, None] * np.cos(angle)[:, None] + second[:, None] * np.sin(angle)[:, None]
        radii = np.broadcast_to(np.asarray(radius, dtype=np.float64), len(path))
        rings = path[:, None] + circle * radii[:, None, None]
        points = np.concatenate([rings.reshape(-1, 3), path[[0, -1]]])
        faces = _grid(len(path), sides, closed=False)
        i, last = np.arange(sides), (len(path) - 1) * sides
        caps = [
            np.stack([np.full(sides, len(points) - 2), (i + 1) % sides, i], axis=1),
            np.stack([np.full(sides, len(points) - 1), last + i, last + (i + 1) % sides], axis=1),
        ]
        self._add(points, np.concatenate([faces, *caps]), surface, moves)

    def ring(self, centre: Float, radius: float, thick: float, surface: int, moves: int) -> None:
        """A torus about y."""
        turn, sides = np.arange(32) * 2 * np.pi / 32, 5
        out = np.stack([np.cos(turn), np.zeros(32), np.sin(turn)], axis=1)
        angle = np.arange(sides) * 2 * np.pi / sides
        rings = out[:, None] * (radius + thick * np.cos(angle))[:, None]
        rings[..., 1] += thick * np.sin(angle)
        points = centre + rings.reshape(-1, 3)
        self._add(points, _grid(32, sides, closed=True)[:, ::-1], surface, moves)

    def wheel(self, axle: Float, moves: int) -> None:
        """Tyre, rim, hub and spokes."""
        self.ring(axle, WHEEL_RADIUS - 0.018, 0.018, TYRE, moves)
        self.ring(axle, WHEEL_RADIUS - 0.045, 0.010, RIM, moves)
        hub = np.array([0.0, 0.05, 0.0])
        self.tube([axle - hub, axle + hub], 0.02, RIM, moves)
        for k in range(16):
            out = np.array([np.cos(k * np.pi / 8), 0.0, np.sin(k * np.pi / 8)])
            near = axle + [0, 0.03 * (-1) ** k, 0] + 0.02 * out
            self.tube([near, axle + (WHEEL_RADIUS - 0.05) * out], 0.0018, RIM, moves, sides=3)

    def build(self, scale: float, saddle: float) -> Bicycle:
        """The whole bicycle, scaled."""
        return Bicycle(
            scale,
            saddle,
            np.concatenate(self.vertices) * scale,
            np.concatenate(self.triangles),
            np.concatenate(self.surfaces),
            np.concatenate(self.moves),
        )

    def _add(self, points: Float, faces: NDArray[np.int64], surface: int, moves: int) -> None:
        self.vertices.append(points)
        self.triangles.append(faces + self.count)
        self.surfaces.append(np.full(len(faces), surface))
        self.moves.append(np.full(len(points), moves))
        self.count += len(points)


def _grid(rings: int, sides: int, *, closed: bool) -> NDArray[np.int64]:
    """Triangles between rings of points."""
    r, s = np.meshgrid(np.arange(rings if closed else rings - 1), np.arange(sides), indexing="ij")
    a, b = r * sides + s, r * sides + (s + 1) % sides
    c, d = (r + 1) % rings * sides + s, (r + 1) % rings * sides + (s + 1) % sides
    return np.concatenate([np.stack([a, b, d], -1), np.stack([a, d, c], -1)]).reshape(-1, 3)
