"""Walking and running along a path, driven by the distance covered.

Footsteps are placed along the path first. Every foot stays at one position on the ground from heel
strike to toe-off, and the legs bend to reach the feet. Feet therefore never slide, at any speed and
on any path. Stride length depends on speed and leg length, for walking and running alike:

    stride = 2.3 (v^2 / (g h))^0.3 h

The formula is from Alexander, "Estimates of speeds of dinosaurs", Nature 261, 1976, for mammals.
The strides of walking people are 10 % longer (113 steps per minute at 1.4 m/s: Perry and Burnfield,
below). The Froude number v^2 / (g h) determines the transition from walking to running (at about
0.5; Alexander, "Optimization and gaits in the locomotion of vertebrates", Physiological Reviews 69,
1989). Angles of the trunk and the arms in walking are rounded from Perry and Burnfield, "Gait
analysis", 2010.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..geometry import Float, matrix_to_quaternion
from .model import (
    JOINTS,
    LATERAL,
    UP,
    Body,
    Pose,
    about,
    aim,
    bend,
    frame,
    partial_turn,
    smooth,
    unit,
)

GRAVITY = 9.81
WALK_TO_RUN = (0.4, 0.8)
"""Froude numbers between which walking blends into running."""
TURN_RADIUS = 0.25
"""Turning on the spot takes as many steps as walking a circle of this radius [m]."""
STANDING = 0.04
"""Below this speed a person stands still [m/s]."""
LEAD = 3.0
"""Before and after a path, a gait continues straight for this time [s]."""
_STEP = 0.01


@dataclass(frozen=True)
class GaitStyle:
    """Walking style; ones and zeros are the mean.

    Attributes:
        stride: factor on the length of strides.
        arms: factor on the swing of the arms.
        lean: additional forward lean [rad].
        width: factor on the distance between the feet's tracks.
        phase: phase offset in steps; 1 starts with the other foot.
    """

    stride: float = 1.0
    arms: float = 1.0
    lean: float = 0.0
    width: float = 1.0
    phase: float = 0.0


@dataclass(frozen=True, eq=False)
class Footsteps:
    """Positions of a foot on the ground.

    Attributes:
        lift, land: [K] step counts along the walk at which it leaves a position and reaches the
            next.
        spots: [K + 1, 3] middle of its hip's track at each position, on the ground, world frame
            [m].
        yaws: [K + 1] direction of the foot [rad].
    """

    lift: Float
    land: Float
    spots: Float
    yaws: Float


@dataclass(frozen=True, eq=False)
class Gait:
    """Motion of a body along a path.

    Attributes:
        body, style: the person's body and walking style.
        times: [N] times of the path [s].
        path: [N, 4] x, y, z on the ground and yaw, world frame.
        steps: [N] number of steps so far; each whole number is one swing of a foot.
        speeds: [N], smoothed [m/s].
        feet: footsteps of the left and of the right foot.
    """

    body: Body
    style: GaitStyle
    times: Float
    path: Float
    steps: Float
    speeds: Float
    feet: tuple[Footsteps, Footsteps]

    def at(self, times: ArrayLike) -> tuple[Float, Float]:
        """Poses x, y, z, yaw [T, 4] on the path and step counts [T] at times [T] [s]."""
        times = np.atleast_1d(np.asarray(times, dtype=np.float64))
        place = np.stack([np.interp(times, self.times, self.path[:, i]) for i in range(4)], -1)
        return place, np.interp(times, self.times, self.steps)

    def pose(self, times: ArrayLike) -> Pose:
        """Poses at times [T] [s], in the body's frame, whose origin is on the path."""
        times = np.atleast_1d(np.asarray(times, dtype=np.float64))
        place, steps = self.at(times)
        speed = np.interp(times, self.times, self.speeds)
        return _Motion(self, place, steps, speed, times).pose()


def stride_length(speed: ArrayLike, leg_length: float) -> Float:
    """Stride length [m] at speeds [m/s] for hips at height ``leg_length`` [m]; see the module."""
    froude = np.asarray(speed, dtype=np.float64) ** 2 / (GRAVITY * leg_length)
    human = 1.1 - 0.1 * running_share(speed, leg_length)
    return human * 2.3 * froude**0.3 * leg_length


def duty_factor(speed: ArrayLike, leg_length: float) -> Float:
    """Fraction of a stride during which a foot is on the ground: 0.7 in slow walking, 0.36 in
    running."""
    froude = np.asarray(speed, dtype=np.float64) ** 2 / (GRAVITY * leg_length)
    running = running_share(speed, leg_length)
    walking = 0.70 - 0.10 * np.clip(np.sqrt(froude) / 0.6, 0.0, 1.0)
    return walking * (1 - running) + 0.36 * running


def running_share(speed: ArrayLike, leg_length: float) -> Float:
    """From 0 for walking to 1 for running."""
    froude = np.asarray(speed, dtype=np.float64) ** 2 / (GRAVITY * leg_length)
    return smooth((froude - WALK_TO_RUN[0]) / (WALK_TO_RUN[1] - WALK_TO_RUN[0]))


def plan_gait(
    body: Body,
    times: ArrayLike,
    positions: ArrayLike,
    yaws: ArrayLike,
    style: GaitStyle | None = None,
) -> Gait:
    """Place footsteps along a path.

    Args:
        body: body of the person.
        times: [N] increasing [s].
        positions: [N, 3] positions of the body's origin on the ground, world frame [m].
        yaws: [N], direction that the body faces [rad].
        style: walking style.

    Returns:
        The gait. Before and after the path it continues straight.

    Raises:
        ValueError: times that do not increase, or arrays of different lengths.
    """
    style = style or GaitStyle()
    times, path = _checked(times, positions, yaws)
    fine, path = _extended(times, path)
    speed = _smoothed(_path_speed(fine, path))
    steps, segments = _count_steps(fine, speed, body.leg_length, style)
    feet = _lay_footsteps(body, style, path, steps, speed, segments)
    return Gait(body, style, fine, path, steps, speed, feet)


def _checked(times: ArrayLike, positions: ArrayLike, yaws: ArrayLike) -> tuple[Float, Float]:
    times = np.asarray(times, dtype=np.float64)
    positions, yaws = np.asarray(positions, np.float64), np.asarray(yaws, np.float64)
    if times.ndim != 1 or positions.shape != (len(times), 3) or yaws.shape != times.shape:
        raise ValueError(
            f"times [N], positions [N, 3] and yaws [N] are needed, not {times.shape}, "
            f"{positions.shape} and {yaws.shape}"
        )
    if len(times) == 0 or (np.diff(times) <= 0).any():
        raise ValueError("times must rise")
    return times, np.column_stack([positions, np.unwrap(yaws)])


def _extended(times: Float, path: Float) -> tuple[Float, Float]:
    """The path resampled evenly and extended straight at both ends."""
    if len(times) == 1:
        times, path = times[0] + np.array([0.0, _STEP]), np.repeat(path, 2, axis=0)
    ends = []
    for near, beyond, sign in ((0, 1, -1.0), (-1, -2, 1.0)):
        velocity = (path[near] - path[beyond]) / (times[near] - times[beyond])
        velocity[3] = 0.0
        ends.append((times[near] + sign * LEAD, path[near] + sign * LEAD * velocity))
    times = np.concatenate([[ends[0][0]], times, [ends[1][0]]])
    path = np.concatenate([[ends[0][1]], path, [ends[1][1]]])
    fine = np.linspace(times[0], times[-1], max(round((times[-1] - times[0]) / _STEP), 2) + 1)
    # Instants that differ only by rounding would give no valid speed.
    apart = np.abs(fine[:, None] - times[np.searchsorted(times, fine)[:, None] - [0, 1]]).min(
        axis=1
    )
    fine = np.union1d(fine[apart > _STEP / 100], times)
    return fine, np.stack([np.interp(fine, times, path[:, i]) for i in range(4)], axis=-1)


def _path_speed(times: Float, path: Float) -> Float:
    change = np.gradient(path, times, axis=0)
    return np.hypot(np.hypot(change[:, 0], change[:, 1]), TURN_RADIUS * change[:, 3])


def _smoothed(speed: Float) -> Float:
    """Moving average over 0.3 s, because recorded paths have jumps in speed."""
    half = round(0.15 / _STEP)
    total = np.concatenate([[0.0], np.cumsum(np.pad(speed, half, mode="edge"))])
    return (total[2 * half + 1 :] - total[: -2 * half - 1]) / (2 * half + 1)  # type: ignore[no-any-return]


def _count_steps(
    times: Float, speed: Float, leg: float, style: GaitStyle
) -> tuple[Float, list[tuple[int, int]]]:
    """Step counts [N], and the first and last step of each segment between two stops.

    Each segment has a whole number of steps, so stride lengths are slightly adjusted.
    """
    going = speed > STANDING
    length = 0.5 * style.stride * stride_length(np.maximum(speed, STANDING), leg)
    rate = np.where(going, speed / length, 0.0)
    made = np.concatenate([[0.0], np.cumsum((rate[1:] + rate[:-1]) / 2 * np.diff(times))])
    edges = np.flatnonzero(np.diff(np.concatenate([[False], going, [False]]).astype(int)))
    steps, done, ways = np.zeros(len(times)), 0, []
    for start, end in zip(edges[::2], edges[1::2] - 1, strict=True):
        count = max(round(made[end] - made[start]), 1)
        scale = count / max(made[end] - made[start], 1e-9)
        steps[start : end + 1] = done + (made[start : end + 1] - made[start]) * scale
        steps[end + 1 :] = done + count
        ways.append((done, done + count))
        done += count
    return steps, ways


def _lay_footsteps(  # noqa: PLR0917 - all that a step depends on
    body: Body,
    style: GaitStyle,
    path: Float,
    steps: Float,
    speed: Float,
    ways: list[tuple[int, int]],
) -> tuple[Footsteps, Footsteps]:
    """Footsteps of both feet; the left foot makes step ``n`` if ``n + phase`` is even."""
    rising = np.concatenate([[True], np.diff(steps) > 0])
    known, where = steps[rising], path[rising]
    feet = []
    for foot in range(2):
        lift, land, spots, yaws = [], [], [], []
        start = where[0]
        spots.append(start[:3])
        yaws.append(start[3])
        for first, last in ways:
            for n in range(first, last):
                if (n + round(style.phase) + foot) % 2:
                    continue
                pace = np.interp(n + 0.5, known, speed[rising])
                swing = 1 - float(duty_factor(pace, body.leg_length))
                lift.append(max(n + 0.5 - swing, first))
                land.append(min(n + 0.5 + swing, last))
                # The body is above the foot in the middle of its stance.
                spot = _place(known, where, min(n + 1.5, last))
                spots.append(spot[:3])
                yaws.append(spot[3])
        lift, land = _apart(lift, land)
        feet.append(Footsteps(np.array(lift), np.array(land), np.array(spots), np.array(yaws)))
    return feet[0], feet[1]


def _place(known: Float, where: Float, step: float) -> Float:
    return np.array([np.interp(step, known, where[:, i]) for i in range(4)])


def _apart(lift: list[float], land: list[float]) -> tuple[list[float], list[float]]:
    """Keep a foot at each position for a minimum time, at any speed."""
    for k in range(1, len(lift)):
        if lift[k] < land[k - 1] + 0.2:
            middle = (lift[k] + land[k - 1]) / 2
            land[k - 1], lift[k] = middle - 0.1, middle + 0.1
    return lift, land


class _Motion:
    """A gait at T instants: poses [T, 4], step counts [T], speeds [T]."""

    def __init__(self, gait: Gait, place: Float, steps: Float, speed: Float, times: Float) -> None:
        self.gait, self.body, self.style = gait, gait.body, gait.style
        self.place, self.steps, self.speed, self.times = place, steps, speed, times
        leg = self.body.leg_length
        self.running = running_share(speed, leg)
        # Fraction of a full stride's motion: none at standstill.
        self.effort = smooth(speed / (0.55 * np.sqrt(GRAVITY * leg)) * 1.2)
        self.turn = np.pi * (steps + round(self.style.phase))

    def pose(self) -> Pose:
        body, count = self.body, len(self.steps)
        local = np.broadcast_to(np.eye(3), (count, len(JOINTS), 3, 3)).copy()
        feet = [self._foot(side) for side in range(2)]
        pelvis_turn = self._pelvis_turn()
        pelvis = self._pelvis_place(pelvis_turn, feet)
        local[:, JOINTS.index("pelvis")] = pelvis_turn
        for (ankle, turned, toes), side in zip(feet, "lr", strict=True):
            hip = pelvis + pelvis_turn @ (body.joint(f"thigh_{side}") - body.joint("pelvis"))
            put_leg(body, local, side, hip, ankle, turned)
            local[:, JOINTS.index(f"ball_{side}")] = about(LATERAL, toes)
        self._put_trunk(local, pelvis_turn)
        return Pose(matrix_to_quaternion(local), pelvis)

    def _foot(self, side: int) -> tuple[Float, Float, Float]:
        """Ankle [T, 3], rotation [T, 3, 3] and bend of the toes [T] of a foot, body frame."""
        foot, walk = Foot(self.body, "lr"[side]), self.gait.feet[side]
        begun = np.searchsorted(walk.lift, self.steps, side="right")
        swinging = (begun > 0) & (self.steps < np.append(0.0, walk.land)[begun])
        ankle, yaw, pitch, toes = self._stance(foot, side, np.where(swinging, begun - 1, begun))
        if swinging.any():
            flown = self._swing(foot, side, np.maximum(begun - 1, 0))
            ankle = np.where(swinging[:, None], flown[0], ankle)
            stood = zip(flown[1:], (yaw, pitch, toes), strict=True)
            yaw, pitch, toes = (np.where(swinging, one, other) for one, other in stood)
        return self._to_body(ankle), foot.turned(yaw - self.place[:, 3], pitch), toes

    def _stance(
        self, foot: Foot, side: int, spot: NDArray[np.int64]
    ) -> tuple[Float, Float, Float, Float]:
        """Ankle [T, 3], yaw, pitch and bend of the toes [T] on a spot, from heel to ball."""
        walk = self.gait.feet[side]
        size = np.concatenate([[0.0], self._sizes(walk), [0.0]])
        leaving, striking = self._off_angle(size[spot + 1]), self._strike_angle(size[spot])
        since, until = np.append(-1e9, walk.land)[spot], np.append(walk.lift, 1e9)[spot]
        share = np.clip((self.steps - since) / np.maximum(until - since, 1e-9), 0, 1)
        down = striking * (1 - smooth(share / 0.16))
        pitch = down + leaving * np.clip((share - 0.4) / 0.6, 0, 1) ** 1.5
        yaw = self._yaw(walk, spot, side)
        ankle = foot.standing(self._spot(walk, spot, side), yaw, pitch)
        return ankle, yaw, pitch, -np.maximum(pitch, 0.0)

    def _swing(
        self, foot: Foot, side: int, spot: NDArray[np.int64]
    ) -> tuple[Float, Float, Float, Float]:
        """Like :meth:`_stance`, for the swing to the next position."""
        walk = self.gait.feet[side]
        p = np.clip((self.steps - walk.lift[spot]) / (walk.land[spot] - walk.lift[spot]), 0, 1)
        size = self._sizes(walk)[spot]
        off, strike = self._off_angle(size), self._strike_angle(size)
        start, end = self._yaw(walk, spot, side), self._yaw(walk, spot + 1, side)
        away = foot.standing(self._spot(walk, spot, side), start, off)
        down = foot.standing(self._spot(walk, spot + 1, side), end, strike)
        # In running, a foot must overtake the body and cannot stay at its old position.
        linear = 0.35 + 0.4 * self.running
        ankle = away + (smooth(p) + linear * (p - smooth(p)))[:, None] * (down - away)
        ankle[:, 2] += self._lift_height(size, p)
        pitch = off * (1 - smooth(p / 0.75)) + strike * smooth((p - 0.45) / 0.55)
        toes = -np.maximum(off, 0) * (1 - smooth(p / 0.4))
        return ankle, start + smooth(p) * (end - start), pitch, toes

    def _sizes(self, walk: Footsteps) -> Float:
        """[K] lengths of a foot's swings, relative to the leg length."""
        return np.linalg.norm(np.diff(walk.spots, axis=0), axis=1) / self.body.leg_length  # type: ignore[no-any-return]

    def _off_angle(self, size: Float) -> Float:
        return np.radians(62) * smooth(size / 1.7)  # type: ignore[no-any-return]

    def _strike_angle(self, size: Float) -> Float:
        return -np.radians(17) * smooth(size / 1.7) * (1 - 0.8 * self.running)  # type: ignore[no-any-return]

    def _lift_height(self, size: Float, p: Float) -> Float:
        leg = self.body.leg_length
        walking = 0.035 * np.sin(np.pi * p) ** 2 + 0.03 * np.sin(np.pi * np.sqrt(p)) ** 2
        height = walking * smooth(size / 0.6) + 0.24 * self.running * np.sin(np.pi * p**0.8) ** 2
        return leg * height  # type: ignore[no-any-return]

    def _spot(self, walk: Footsteps, index: NDArray[np.int64], side: int) -> Float:
        """Position of the ankle with a flat foot [T, 3], world frame."""
        yaw = walk.yaws[index]
        sign = 1.0 - 2.0 * side
        hip = self.body.joint("thigh_l")[1]
        width = hip * self.style.width * 0.62
        behind = -0.09 * self.body.leg_length
        offset = np.stack(
            [
                behind * np.cos(yaw) - sign * width * np.sin(yaw),
                behind * np.sin(yaw) + sign * width * np.cos(yaw),
                np.zeros_like(yaw),
            ],
            axis=-1,
        )
        return walk.spots[index] + offset  # type: ignore[no-any-return]

    def _yaw(self, walk: Footsteps, index: NDArray[np.int64], side: int) -> Float:
        return walk.yaws[index] + (1 - 2 * side) * np.radians(6)  # type: ignore[no-any-return]

    def _to_body(self, points: Float) -> Float:
        away = points - self.place[:, :3]
        return (np.swapaxes(about(UP, self.place[:, 3]), -1, -2) @ away[..., None])[..., 0]

    def _pelvis_turn(self) -> Float:
        yaw = np.radians(5) * self.effort * np.cos(self.turn)
        list_ = -np.radians(4) * self.effort * np.sin(self.turn)
        lean = np.radians(2) * self.effort + np.radians(6) * self.running
        return about(UP, yaw) @ about(LATERAL, lean) @ about([1, 0, 0], list_)

    def _pelvis_place(self, turned: Float, feet: list[tuple[Float, Float, Float]]) -> Float:
        """The maximum height that both legs allow, with smooth transitions."""
        body, leg = self.body, self.body.leg_length
        sway = -0.02 * leg * self.effort * np.sin(self.turn) * (1 - 0.5 * self.running)
        idle = 0.006 * leg * (1 - self.effort)
        sway = sway + idle * np.sin(0.9 * self.times + 3 * self.style.phase)
        pelvis = np.stack([idle * np.sin(0.6 * self.times), sway, np.zeros_like(sway)], axis=-1)
        bob = 0.035 * leg * self.running * (1 + np.cos(2 * self.turn - np.pi)) / 2
        limits = [
            body.joint("pelvis")[2] * (1 - 0.03 * self.running) - 0.035 * leg * self.running + bob
        ]
        for (ankle, _, _), side in zip(feet, "lr", strict=True):
            hip = (turned @ (body.joint(f"thigh_{side}") - body.joint("pelvis"))) + pelvis
            away = np.linalg.norm((ankle - hip)[:, :2], axis=-1)
            full = 0.998 * leg_lengths(body, side)[0] + 0.998 * leg_lengths(body, side)[1]
            rise = np.sqrt(np.maximum(full**2 - away**2, (0.3 * leg) ** 2))
            limits.append(ankle[:, 2] + rise - hip[:, 2])
        soft = 0.02 * leg
        lowest = np.min(limits, axis=0)
        pelvis[:, 2] = lowest - soft * np.log(
            sum(np.exp(-(limit - lowest) / soft) for limit in limits)
        )
        return pelvis

    def _put_trunk(self, local: Float, pelvis_turn: Float) -> None:
        swing = self.effort * np.cos(self.turn)
        lean = self.style.lean + np.radians(1.5) * self.effort + np.radians(7) * self.running
        chest = about(UP, -np.radians(6) * swing) @ about(LATERAL, lean)
        put_spine(local, pelvis_turn, chest, about(LATERAL, 0.3 * lean))
        for side, sign in (("l", 1.0), ("r", -1.0)):
            # An arm moves with the opposite leg.
            ahead = (
                sign * swing * self.style.arms * (np.radians(20) + np.radians(22) * self.running)
            )
            shoulder = ahead - np.radians(4) * self.effort
            elbow = np.radians(12) + np.radians(10) * self.effort + np.radians(62) * self.running
            elbow = elbow + np.maximum(ahead, 0) * 0.7
            out = np.radians(8) + np.radians(4) * self.running
            put_arm(self.body, local, side, shoulder, elbow, out)


class Foot:
    """A foot in the rest pose.

    Attributes:
        ankle, ball: [3] joints.
        heel: [3] rearmost point on the ground.
        yaw: direction [rad].
    """

    def __init__(self, body: Body, side: str) -> None:
        self.ankle, self.ball = body.joint(f"foot_{side}"), body.joint(f"ball_{side}")
        away = self.ball - self.ankle
        self.yaw = float(np.arctan2(away[1], away[0]))
        part = body.vertices[body.model.parts == body.model.part_names.index(f"foot_{side}")]
        along = part[:, :2] @ unit(away[:2])
        back = part[along < along.min() + 0.02 * body.leg_length]
        self.heel = np.array([*back[:, :2].mean(axis=0), 0.0])

    def standing(self, spots: Float, yaw: Float, pitch: Float) -> Float:
        """Ankles [T, 3] above spots, rolled over the heel (pitch < 0) or the ball (pitch > 0)."""
        flat = about(UP, yaw - self.yaw)
        rolled = self.turned(yaw, pitch)
        pivot = np.where((pitch > 0)[:, None], self.ball, self.heel)
        ground = np.array([0.0, 0.0, self.ankle[2]])
        at = spots + ground + (flat @ (pivot - self.ankle)[..., None])[..., 0]
        return at + (rolled @ (self.ankle - pivot)[..., None])[..., 0]  # type: ignore[no-any-return]

    def turned(self, yaw: Float, pitch: Float) -> Float:
        """Rotations [T, 3, 3] from the rest pose."""
        square = np.array([-np.sin(self.yaw), np.cos(self.yaw), 0.0])
        return about(UP, yaw - self.yaw) @ about(square, pitch)


def leg_lengths(body: Body, side: str) -> tuple[float, float]:
    """Lengths of thigh and calf [m]."""
    hip, knee, ankle = (body.joint(f"{name}_{side}") for name in ("thigh", "calf", "foot"))
    return float(np.linalg.norm(knee - hip)), float(np.linalg.norm(ankle - knee))


def put_leg(  # noqa: PLR0917 - hip, ankle and foot are one leg
    body: Body, local: Float, side: str, hip: Float, ankle: Float, foot: Float
) -> None:
    """Set the rotations of thigh, calf and foot in ``local``; the pelvis must be set.

    Args:
        body: body with the leg.
        local: [T, J, 3, 3] rotations, modified in place.
        side: "l" or "r".
        hip, ankle: joints [T, 3] in the body frame.
        foot: [T, 3, 3] rotation of the foot in the body frame.
    """
    pelvis = local[:, JOINTS.index("pelvis")]
    ahead = unit(pelvis[:, :, 0] + foot[:, :, 0] * [1, 1, 0.0])
    knee = bend(hip, ankle, *leg_lengths(body, side), ahead)
    lateral = np.cross(UP, ahead)
    rest_hip, rest_knee, rest_ankle = (
        body.joint(f"{name}_{side}") for name in ("thigh", "calf", "foot")
    )
    thigh = frame(knee - hip, lateral) @ frame(rest_knee - rest_hip, LATERAL).T
    calf = frame(ankle - knee, lateral) @ frame(rest_ankle - rest_knee, LATERAL).T
    local[:, JOINTS.index(f"thigh_{side}")] = np.swapaxes(pelvis, -1, -2) @ thigh
    local[:, JOINTS.index(f"calf_{side}")] = np.swapaxes(thigh, -1, -2) @ calf
    local[:, JOINTS.index(f"foot_{side}")] = np.swapaxes(calf, -1, -2) @ foot


def put_spine(local: Float, pelvis: Float, chest: Float, head: Float) -> None:
    """Distribute the pelvis-to-chest rotation over the spine, and chest-to-head over the neck."""
    part = partial_turn(np.swapaxes(pelvis, -1, -2) @ chest, 1 / 3)
    for name in ("spine_1", "spine_2", "spine_3"):
        local[:, JOINTS.index(name)] = part
    part = partial_turn(np.swapaxes(chest, -1, -2) @ head, 1 / 2)
    for name in ("neck", "head"):
        local[:, JOINTS.index(name)] = part


def put_arm(  # noqa: PLR0917 - the angles of one arm
    body: Body, local: Float, side: str, shoulder: Float, elbow: Float, out: ArrayLike
) -> None:
    """Pose an arm.

    Args:
        body: body with the arm.
        local: [T, J, 3, 3] rotations, modified in place.
        side: "l" or "r".
        shoulder: [T] forward swing of the upper arm relative to the chest [rad].
        elbow: [T] bend [rad].
        out: angle of the arm from the side [rad].
    """
    sign = 1.0 if side == "l" else -1.0
    out = np.broadcast_to(np.asarray(out, dtype=np.float64), shoulder.shape)
    joints = [body.joint(f"{name}_{side}") for name in ("upper_arm", "forearm", "hand")]
    down = np.stack([np.sin(shoulder), sign * np.sin(out), -np.cos(shoulder) * np.cos(out)], -1)
    bent = shoulder + elbow
    low = np.stack([np.sin(bent), np.full_like(bent, -sign * 0.05), -np.cos(bent)], axis=-1)
    upper = aim(joints[1] - joints[0], down)
    fore = aim((upper @ (joints[2] - joints[1])[:, None])[..., 0], low) @ upper
    local[:, JOINTS.index(f"upper_arm_{side}")] = upper
    local[:, JOINTS.index(f"forearm_{side}")] = np.swapaxes(upper, -1, -2) @ fore
