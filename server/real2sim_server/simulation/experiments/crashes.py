"""Crash tests on the street of a scene: frontal, T-bone, pole, roof.

Each takes place on the recorded road, ahead of the recording vehicle, with vehicles of the scene
moved there as they were lit, and is seen from the side that the recording saw best.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...geometry.rotation import Float
from ...geometry.transform import apply_transform
from ...physics.colliders import Box, Collider
from ...physics.errors import PhysicsError
from ..playback import PlacedObject
from ..presets import ObjectPhysics
from ..rollout import SimulateOptions
from ..structure import VEHICLES
from .setup import Experiment, Request, beside, level, others_near, scene_road
from .viewing import visibility_of

AHEAD = 14.0
"""From where the recording begins to where a crash takes place, along its path [m]."""
GAP = 1.2
"""To what is hit, at the start [m]."""
BARRIER = (0.8, 2.4, 1.0)
"""Depth, width, height of the block of a frontal crash [m]."""
POLE, POLE_HEIGHT = 0.25, 2.6
"""Of a lamp post: width and height [m]."""
OFF_CENTRE = 0.12
"""Of the width: where a pole meets a front, beside its middle."""
ASIDE = 0.8
"""Where a T-bone is looked at, from the middle of what is struck towards what strikes it [m]."""
TURNED_OVER = np.radians(158.0)
"""About its length, of a vehicle that falls on the edge of its roof (SAE J996 has 25 degrees of
roll)."""
FALL = 0.4
"""Of the lowest corner above the road at the start of a roof crash [m]; it is falling by then."""
FRAME_RATE, SLOW = 60.0, 4.0
"""Frames a second, and how many times slower a film shows them than they were."""


def frontal(request: Request) -> Experiment:
    """One vehicle squarely into a block of concrete, at 15 m/s."""
    subject = _best(request)
    speed = 15.0 if request.speed is None else request.speed
    pose, forward = _on_the_road(request, subject)
    nose = pose[:3, 3] + subject.scaled_size[0] / 2 * forward
    block = _standing_box(
        "barrier", BARRIER, nose + (GAP + BARRIER[0] / 2) * forward, forward, request
    )
    focus = nose + (GAP - 0.9) * forward
    side = beside(request.scene, subject, pose)
    return _experiment(
        request, "frontal", subject, speed * forward, [block], focus=focus, side=side
    )


def pole(request: Request) -> Experiment:
    """One vehicle with its front into a post, at 12 m/s."""
    subject = _best(request)
    speed = 12.0 if request.speed is None else request.speed
    pose, forward = _on_the_road(request, subject)
    left = np.cross([0.0, 0.0, 1.0], forward)
    seen_side = np.sign(visibility_of(request.scene, subject).direction[1]) or 1.0
    nose = pose[:3, 3] + subject.scaled_size[0] / 2 * forward
    place = nose + (GAP + POLE / 2) * forward
    place = place + seen_side * OFF_CENTRE * subject.scaled_size[1] * left
    post = _standing_box("pole", (POLE, POLE, POLE_HEIGHT), place, forward, request)
    # From ahead, where what a post leaves of a front is seen on both of its sides.
    side = beside(request.scene, subject, pose, ahead=1.0, rise=0.65)
    return _experiment(request, "pole", subject, speed * forward, [post], focus=nose, side=side)


def t_bone(request: Request) -> Experiment:
    """One vehicle into the middle of the side of another that stands, at 15 m/s."""
    speed = 15.0 if request.speed is None else request.speed
    runner = _best(request)
    others = [s for s in _candidates(request) if s is not runner]
    if not others:
        raise PhysicsError("two vehicles are needed; name two with objects")
    struck = _seen_best(request, others)
    own, forward = _on_the_road(request, runner)
    left = np.cross([0.0, 0.0, 1.0], forward)
    # The side that was seen is the one that is struck.
    ahead = left if visibility_of(request.scene, struck).direction[1] >= 0 else -left
    reach = runner.scaled_size[0] / 2 + GAP + struck.scaled_size[1] / 2
    target = np.eye(4)
    target[:3, :3] = np.stack([ahead, np.cross([0, 0, 1.0], ahead), [0, 0, 1.0]], axis=1)
    target[:3, 3] = own[:3, 3] + reach * forward
    target[2, 3] = _height(request, struck, target)
    objects = {
        runner.object_id: ObjectPhysics(T_world_object=own, velocity=speed * forward),
        struck.object_id: ObjectPhysics(T_world_object=target, velocity=(0.0, 0.0, 0.0)),
    }
    # Along the struck side and past the runner, going along with the struck one: the dent is seen
    # between them when they have parted.
    side = ahead - 0.6 * forward + np.array([0.0, 0.0, 0.5])
    focus = target[:3, 3] - ASIDE * forward
    plan = _made(request, "t_bone", objects, [], focus=focus, side=side, distance=6.5)
    return replace(plan, follows=struck.object_id)


def roof(request: Request) -> Experiment:
    """One vehicle upside down on the edge of its roof, as after a fall of 1.5 m."""
    speed = 5.4 if request.speed is None else request.speed
    subject = _best(request)
    own, forward = _on_the_road(request, subject)
    left = np.cross([0.0, 0.0, 1.0], forward)
    seen = 1.0 if visibility_of(request.scene, subject).direction[1] >= 0 else -1.0
    # Turned over, the side that was seen is on the other side, and its edge comes down first.
    turn = -seen * TURNED_OVER
    side = forward - seen * 1.1 * left + np.array([0.0, 0.0, 0.08])
    c, s = np.cos(turn), np.sin(turn)
    own[:3, :3] = own[:3, :3] @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    half = np.array(subject.scaled_size) / 2
    corners = half * (np.indices((2, 2, 2)).reshape(3, 8).T * 2 - 1)
    lowest = float(apply_transform(own, corners)[:, 2].min())
    road = request.scene.ground.height(own[0, 3], own[1, 3])
    own[2, 3] += road + FALL - lowest
    objects = {
        subject.object_id: ObjectPhysics(T_world_object=own, velocity=(0.0, 0.0, -speed)),
    }
    focus = np.array([*own[:2, 3], road + half[2]])
    return _made(request, "roof", objects, [], focus=focus, side=side, distance=6.3)


CRASHES = {"frontal": frontal, "t_bone": t_bone, "pole": pole, "roof": roof}


def _best(request: Request) -> PlacedObject:
    """The vehicle named first, else the car that was seen best."""
    candidates = _candidates(request)
    return candidates[0] if request.named else _seen_best(request, candidates)


def _candidates(request: Request) -> list[PlacedObject]:
    """Vehicles named, else all cars that are there at the start; they are moved anyway."""
    if request.named:
        return list(request.chosen)
    there = [
        s
        for s in request.state.visible
        if s.category in VEHICLES and s.trajectory.covers(request.start_us)
    ]
    return [s for s in there if s.category == "car"] or there


def _seen_best(request: Request, candidates: list[PlacedObject]) -> PlacedObject:
    """Whose front and one of whose sides were seen best; what nobody saw cannot be shown."""

    def seen(subject: PlacedObject) -> float:
        visibility = visibility_of(request.scene, subject)
        return visibility.front * abs(float(visibility.direction[1]))

    return max(candidates, key=seen)


def _on_the_road(request: Request, subject: PlacedObject) -> tuple[Float, Float]:
    """Its pose [4, 4], moved to where crashes take place, and where it faces there [3]."""
    pose = subject.trajectory.transform(request.start_us)
    path = request.scene.ego.positions
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    before = float(np.interp(request.start_us, request.scene.ego.times_us, along))
    place = [np.interp(before + AHEAD, along, path[:, k]) for k in range(2)]
    moved = np.array(pose)
    moved[:2, 3] = place
    moved[2, 3] = _height(request, subject, moved)
    return moved, level(pose[:3, 0])


def _height(request: Request, subject: PlacedObject, pose: Float) -> float:
    """Of its centre where it stands on the ground at the place of ``pose`` as it does now [m]."""
    ground = request.scene.ground
    x, y, z = subject.trajectory.transform(request.start_us)[:3, 3]
    return float(z - ground.height(x, y) + ground.height(pose[0, 3], pose[1, 3]))


def _standing_box(
    name: str, size: tuple[float, float, float], at: Float, forward: Float, request: Request
) -> Box:
    """A box on the ground, across ``forward``."""
    pose = np.eye(4)
    pose[:3, :3] = np.stack([forward, np.cross([0, 0, 1.0], forward), [0, 0, 1.0]], axis=1)
    pose[:2, 3] = at[:2]
    pose[2, 3] = request.scene.ground.height(at[0], at[1]) + size[2] / 2
    return Box(name=name, T_world_box=pose, size=size, friction=0.4)


def _experiment(
    request: Request,
    name: str,
    subject: PlacedObject,
    velocity: Float,
    obstacles: list[Collider],
    *,
    focus: Float,
    side: Float,
) -> Experiment:
    """One vehicle on the road into obstacles."""
    own, _ = _on_the_road(request, subject)
    objects = {subject.object_id: ObjectPhysics(T_world_object=own, velocity=velocity)}
    return _made(request, name, objects, obstacles, focus=focus, side=side, distance=6.0)


def _made(
    request: Request,
    name: str,
    objects: dict[str, ObjectPhysics],
    obstacles: list[Collider],
    *,
    focus: Float,
    side: Float,
    distance: float,
) -> Experiment:
    road = scene_road(request.scene, request.state, request.start_us)
    options = SimulateOptions(
        preset=request.preset,
        objects=objects,
        colliders=[road, *obstacles],
        start_us=request.start_us,
        duration=1.0,
        frame_rate=FRAME_RATE,
    )
    return Experiment(
        name,
        options,
        tuple(objects),
        focus,
        side,
        distance,
        without=others_near(request, options, focus),
        slow=SLOW,
    )
