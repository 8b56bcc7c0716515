"""Experiments with vehicles of a scene: the three of the paper, and crash tests on its road."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...geometry import Float, apply_transform, box_penetration
from ...physics.colliders import Box, Collider, HeightField, Plane
from ...physics.errors import PhysicsError
from ...physics.materials import FixedCorotated
from ...scene import Camera, Scene
from ..background import ground_collider
from ..result import PlacedObject, PlacedObjects
from ..rollout import SimulateOptions
from ..spawn import object_particles, spaced_for
from ..structure import VEHICLES, ObjectPhysics, preset_of

# Views from the recording vehicle. Sides that no camera has recorded cannot be shown.

VIEWS_MAX = 24
"""Maximum number of recorded frames to evaluate."""
DEPTH_MIN = 2.0


@dataclass(frozen=True, eq=False)
class Visibility:
    """Visibility of an object over the recording.

    Attributes:
        direction: [3] towards the cameras, object frame: sum of the view directions weighted by the
            solid angle of the object; longer for better visibility.
        front, rear: total solid angles of views from ahead and from behind.
    """

    direction: Float
    front: float
    rear: float

    @property
    def whole(self) -> float:
        """Total solid angle of all views."""
        return self.front + self.rear


def visibility_of(scene: Scene, subject: PlacedObject) -> Visibility:
    """Visibility of ``subject`` in all cameras of the scene."""
    times = [int(t) for t in scene.frame_times_us if subject.trajectory.covers(int(t))]
    total, front, rear = np.zeros(3), 0.0, 0.0
    for t_us in times[:: max(len(times) // VIEWS_MAX, 1)]:
        pose, ego = subject.trajectory.transform(t_us), scene.ego.transform(t_us)
        for camera in scene.rig.cameras:
            if not in_view(camera, ego, pose[:3, 3], farthest=np.inf):
                continue
            eye = camera.pose(ego)[:3, 3]
            towards = (eye - pose[:3, 3]) @ pose[:3, :3]
            distance = float(np.linalg.norm(towards))
            angle = subject.scaled_size[1] * subject.scaled_size[2] / distance**2
            total += angle * towards / distance
            cosine = towards[0] / distance
            front, rear = front + angle * max(cosine, 0.0), rear + angle * max(-cosine, 0.0)
    return Visibility(total, front, rear)


def in_view(
    camera: Camera, T_world_vehicle: Float, point: Float, *, farthest: float, nearest: float = 0.0
) -> bool:
    """Whether a world point is in the camera's image, between two depths [m]."""
    x, y, z = (camera.viewmat(T_world_vehicle) @ np.append(point, 1.0))[:3]
    if not max(nearest, DEPTH_MIN) < z < farthest:
        return False
    u = camera.K[0, 0] * x / z + camera.K[0, 2]
    v = camera.K[1, 1] * y / z + camera.K[1, 2]
    return bool(0 < u < camera.width and 0 < v < camera.height)


# Experiments, and the parts of a scene they need.

SIDEWAYS, SLANT_MIN = 2.0, 0.25
"""Maximum lateral over longitudinal component of near views, as a multiple of the recorded one; and
the minimum of this limit."""
ROAD_FRICTION = 0.7
CLEARED = 11.0
"""Uninvolved objects closer to the experiment than this are hidden [m]."""
FROM_AHEAD = 0.18
"""Default forward over lateral component of views from the side."""


@dataclass(frozen=True, eq=False)
class Experiment:
    """A simulation and its camera.

    Attributes:
        name: name of the experiment.
        options: simulation options.
        subjects: objects that are shown.
        focus: [3] target point of the near camera, world frame [m].
        side: [3] unit vector from the focus to the near camera.
        distance: distance of that camera from the focus [m].
        without: objects that are not shown.
        slow: slow-motion factor of films.
        follows: subject that the near camera follows; None if it is fixed.
    """

    name: str
    options: SimulateOptions
    subjects: tuple[str, ...]
    focus: Float
    side: Float
    distance: float
    without: frozenset[str] = frozenset()
    slow: float = 1.0
    follows: str | None = None


@dataclass(frozen=True, eq=False)
class Request:
    """Input of an experiment's setup.

    Attributes:
        scene, state: the scene and its objects.
        chosen: candidate vehicles, most visible first; in the given order if ``named``.
        start_us: scene time [us].
        preset: material preset.
        speed: [m/s]; None for the experiment's default.
        grids: requested grids of objects, see ``ObjectPhysics.grid``.
    """

    scene: Scene
    state: PlacedObjects
    chosen: tuple[PlacedObject, ...]
    named: bool
    start_us: int
    preset: str
    speed: float | None
    grids: tuple[int, ...] = ()


def scene_road(scene: Scene, state: PlacedObjects, t_us: int) -> HeightField:
    """The scene's ground around all objects present at ``t_us`` and around the ego's path."""
    there = [
        o.trajectory.pose(t_us)[0][None, :2] for o in state.visible if o.trajectory.covers(t_us)
    ]
    places = np.concatenate([scene.ego.positions[:, :2], *there])
    return ground_collider(scene.ground, places, friction=ROAD_FRICTION)


def level(direction: Float) -> Float:
    """The horizontal unit vector of a direction."""
    flat = np.array([direction[0], direction[1], 0.0])
    return flat / max(float(np.linalg.norm(flat)), 1e-9)


def viewer(
    scene: Scene, subject: PlacedObject, pose: Float, *, slant: float, rise: float = 0.4
) -> Float:
    """Direction [3] to a camera on the recorded side and end.

    Args:
        slant: lateral over longitudinal component; reduced for sides that are hardly visible.
        rise: upward component.
    """
    x, y, _ = visibility_of(scene, subject).direction
    slant = min(slant, max(SIDEWAYS * abs(y) / max(abs(x), 1e-9), SLANT_MIN))
    along = (1.0 if x >= 0 else -1.0) * level(pose[:3, 0])
    side = (1.0 if y >= 0 else -1.0) * slant * level(np.cross([0, 0, 1], pose[:3, 0]))
    direction: Float = level(along + side) + np.array([0.0, 0.0, rise])
    return direction


def beside(
    scene: Scene,
    subject: PlacedObject,
    pose: Float,
    *,
    ahead: float = FROM_AHEAD,
    rise: float = 0.35,
) -> Float:
    """Direction [3] to a camera on the recorded side.

    Args:
        ahead: forward over lateral component; keep it small for broad obstacles, which would hide
            the subject.
        rise: upward component.
    """
    forward = level(pose[:3, 0])
    left = np.cross([0.0, 0.0, 1.0], forward)
    seen = 1.0 if visibility_of(scene, subject).direction[1] >= 0 else -1.0
    direction: Float = seen * left + ahead * forward + np.array([0.0, 0.0, rise])
    return direction


def others_near(request: Request, options: SimulateOptions, focus: Float) -> frozenset[str]:
    """Uninvolved objects that would drive through the experiment."""
    times = options.start_us + np.linspace(0, options.duration * 1e6, 5).astype(np.int64)
    return frozenset(
        s.object_id
        for s in request.state.visible
        if s.object_id not in options.objects
        and any(
            np.linalg.norm(s.trajectory.pose(int(t))[0] - focus) < CLEARED
            for t in times
            if s.trajectory.covers(int(t))
        )
    )


# Crash tests: frontal, T-bone, pole, roof.
#

AHEAD = 14.0
"""Distance of the crash site from the start of the recorded path [m]."""
GAP = 1.2
"""Initial gap to the obstacle [m]."""
BARRIER = (0.8, 2.4, 1.0)
"""Depth, width and height of the block of a frontal crash [m]."""
POLE, POLE_HEIGHT = 0.25, 2.6
"""Width and height of a lamp post [m]."""
OFF_CENTRE = 0.12
"""Lateral offset of the pole from the middle of the front, as a fraction of the width."""
ASIDE = 0.8
"""Distance of the focus of a T-bone from the middle of the struck vehicle, towards the other [m].
"""
TURNED_OVER = np.radians(158.0)
"""Roll angle of a vehicle that falls on the edge of its roof: 22 degrees from upside down (SAE J996
has 25 degrees of roll)."""
FALL = 0.4
"""Height of the lowest corner above the road at the start of a roof crash [m]; the vehicle is
already falling."""
FRAME_RATE, SLOW = 60.0, 4.0
"""Frame rate [Hz], and slow-motion factor of films."""


def frontal(request: Request) -> Experiment:
    """One vehicle hits a concrete block head-on at 15 m/s."""
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
    """One vehicle hits a post frontally at 12 m/s."""
    subject = _best(request)
    speed = 12.0 if request.speed is None else request.speed
    pose, forward = _on_the_road(request, subject)
    left = np.cross([0.0, 0.0, 1.0], forward)
    seen_side = np.sign(visibility_of(request.scene, subject).direction[1]) or 1.0
    nose = pose[:3, 3] + subject.scaled_size[0] / 2 * forward
    place = nose + (GAP + POLE / 2) * forward
    place = place + seen_side * OFF_CENTRE * subject.scaled_size[1] * left
    post = _standing_box("pole", (POLE, POLE, POLE_HEIGHT), place, forward, request)
    # From ahead, where the crushed front is visible on both sides of the post.
    side = beside(request.scene, subject, pose, ahead=1.0, rise=0.65)
    return _experiment(request, "pole", subject, speed * forward, [post], focus=nose, side=side)


def t_bone(request: Request) -> Experiment:
    """One vehicle hits the middle of a stationary vehicle's side at 15 m/s."""
    speed = 15.0 if request.speed is None else request.speed
    runner = _best(request)
    others = [s for s in _candidates(request) if s is not runner]
    if not others:
        raise PhysicsError("two vehicles are needed; name two with objects")
    struck = _seen_best(request, others)
    own, forward = _on_the_road(request, runner)
    left = np.cross([0.0, 0.0, 1.0], forward)
    # Strike the recorded side.
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
    # Look along the struck side past the striking vehicle and follow the struck one. The dent is
    # visible between them after they have separated.
    side = ahead - 0.6 * forward + np.array([0.0, 0.0, 0.5])
    focus = target[:3, 3] - ASIDE * forward
    plan = _made(request, "t_bone", objects, [], focus=focus, side=side, distance=6.5)
    return replace(plan, follows=struck.object_id)


def roof(request: Request) -> Experiment:
    """One vehicle lands upside down on the edge of its roof, as after a fall of 1.5 m."""
    speed = 5.4 if request.speed is None else request.speed
    subject = _best(request)
    own, forward = _on_the_road(request, subject)
    left = np.cross([0.0, 0.0, 1.0], forward)
    seen = 1.0 if visibility_of(request.scene, subject).direction[1] >= 0 else -1.0
    # Upside down, the recorded side is on the opposite side, and its edge lands first.
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
    """The first named vehicle, else the car with the best recording."""
    candidates = _candidates(request)
    return candidates[0] if request.named else _seen_best(request, candidates)


def _candidates(request: Request) -> list[PlacedObject]:
    """The named vehicles, else all cars at the start; experiments replace their poses."""
    if request.named:
        return list(request.chosen)
    there = [
        s
        for s in request.state.visible
        if s.category in VEHICLES and s.trajectory.covers(request.start_us)
    ]
    return [s for s in there if s.category == "car"] or there


def _seen_best(request: Request, candidates: list[PlacedObject]) -> PlacedObject:
    """The car with the best recorded front and side; unseen sides cannot be shown."""

    def seen(subject: PlacedObject) -> float:
        visibility = visibility_of(request.scene, subject)
        return visibility.front * abs(float(visibility.direction[1]))

    return max(candidates, key=seen)


def _on_the_road(request: Request, subject: PlacedObject) -> tuple[Float, Float]:
    """Pose [4, 4] of the vehicle at the crash site, and its forward direction there [3]."""
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
    """Height of its centre at the position of ``pose``, at its current height above ground [m]."""
    ground = request.scene.ground
    x, y, z = subject.trajectory.transform(request.start_us)[:3, 3]
    return float(z - ground.height(x, y) + ground.height(pose[0, 3], pose[1, 3]))


def _standing_box(
    name: str, size: tuple[float, float, float], at: Float, forward: Float, request: Request
) -> Box:
    """A box on the ground, perpendicular to ``forward``."""
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
    """One vehicle on the road that drives into obstacles."""
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


WALL_GAP = 0.5
"""Initial gap between vehicle and wall [m]: contact after 1 s at 0.5 m/s."""
DROP_HEIGHT = 1.225
"""Drop height: free fall of 0.5 s [m]."""
DAMPED = FixedCorotated(young=2e6, poisson=0.4, density=200.0, viscosity=1.5e4)
"""The paper's material for the fall, with damping. The undamped material of the paper rebounds by a
third of the height for a block of this size; this viscosity leaves a slight bounce."""
PAIR_GAP = 1.5
"""Initial gap between colliding vehicles [m]: contact after 0.43 s at 3.5 m/s."""
APART, ASIDE_STEP, ASIDE_TRIES = 0.4, 0.5, 400
"""Clearance between colliding pairs [m], lateral step to reach it [m], and maximum number of steps.
"""
DEPTH_RANGE = (4.0, 45.0)


def set_up(
    name: str,
    scene: Scene,
    state: PlacedObjects,
    *,
    preset: str | None = None,
    speed: float | None = None,
    objects: tuple[str, ...] = (),
    start_us: int | None = None,
    grids: Sequence[int] = (),
) -> Experiment:
    """Set up an experiment on a scene.

    Args:
        name: ``wall``: one vehicle hits a virtual wall. ``pair``: vehicles hit an equal number of
            stationary ones, without gravity. ``drop``: vehicles drop on the extracted ground.
            ``frontal``, ``t_bone``, ``pole``, ``roof``: the crash tests above.
        preset: material preset; by default ``paper`` for the paper's experiments and ``vehicle``
            for crashes.
        speed: [m/s]; the experiment's default if None.
        objects: ids of the objects; by default the visible vehicles whose impact side was recorded
            best. ``pair`` takes two or more: the first half drives into the others, and the last
            one of an odd number is stationary.
        start_us: [us]; the first frame by default.
        grids: requested grids, see ``ObjectPhysics.grid``; they determine the extent of particles.

    Raises:
        PhysicsError: unknown name or objects, or no vehicles in view.
    """
    builders = {"wall": _wall, "pair": _pair, "drop": _drop, **CRASHES}
    if name not in builders:
        raise PhysicsError(f"unknown experiment {name!r}; allowed are {', '.join(builders)}")
    there = {o.object_id: o for o in state.visible}
    unknown = [o for o in objects if o not in there]
    if unknown:
        raise PhysicsError(f"no objects {unknown}; there are {sorted(there)}")
    start_us = int(scene.frame_times_us[0]) if start_us is None else start_us
    chosen = [there[o] for o in objects] or most_visible(scene, state, start_us)
    if not chosen:
        raise PhysicsError(f"no vehicles in view at {start_us} us; name some with objects")
    preset = preset or ("vehicle" if name in CRASHES else "paper")
    return builders[name](
        Request(scene, state, tuple(chosen), bool(objects), start_us, preset, speed, tuple(grids))
    )


def most_visible(scene: Scene, state: PlacedObjects, t_us: int) -> list[PlacedObject]:
    """Vehicles in front of the first camera, in order of decreasing size in its image."""
    camera = scene.rig.cameras[0]
    ego = scene.ego.transform(t_us)
    found = []
    for subject in state.visible:
        if subject.category not in VEHICLES or not subject.trajectory.covers(t_us):
            continue
        place = subject.trajectory.transform(t_us)[:3, 3]
        near, far = DEPTH_RANGE
        if in_view(camera, ego, place, nearest=near, farthest=far):
            z = float((camera.viewmat(ego) @ np.append(place, 1.0))[2])
            found.append((z / subject.scaled_size[2], subject.object_id, subject))
    return [subject for _, _, subject in sorted(found, key=lambda f: f[:2])]


def _wall(request: Request) -> Experiment:
    start_us = request.start_us
    # The crushed end must be visible in the recording.
    subject = max(request.chosen, key=lambda s: visibility_of(request.scene, s).front)
    speed = 2.5 if request.speed is None else request.speed
    pose = subject.trajectory.transform(start_us)
    forward, length = level(pose[:3, 0]), subject.scaled_size[0]
    front = pose[:3, 3] + _reach(request, subject)[1][0] * forward
    wall = Plane(name="wall", point=front + WALL_GAP * forward, normal=-forward, friction=0.3)
    options = SimulateOptions(
        preset=request.preset,
        objects={
            subject.object_id: ObjectPhysics(velocity=speed * forward, friction=ROLLING_FRICTION)
        },
        colliders=[_standing_road(request, subject), wall],
        start_us=start_us,
        duration=WALL_GAP / speed + 1.0,
    )
    focus = front - 0.25 * length * forward
    return Experiment(
        "wall",
        options,
        (subject.object_id,),
        focus,
        beside(request.scene, subject, pose),
        7.5,
        without=others_near(request, options, focus),
    )


ROLLING_FRICTION = 0.0
"""Vehicles of the paper's preset have no wheels; frictionless sliding replaces rolling."""


def _standing_road(request: Request, subject: PlacedObject) -> Collider:
    """The road; without wheels it must not overlap the vehicle's underside."""
    if request.preset != "paper":
        return scene_road(request.scene, request.state, request.start_us)
    pose = subject.trajectory.transform(request.start_us)
    return Plane(
        name="ground",
        point=pose[:3, 3] + _reach(request, subject)[0][2] * pose[:3, 2],
        normal=pose[:3, 2],
        friction=0.0,
    )


def _pair(request: Request) -> Experiment:
    """Two vehicles start behind stationary ones, half a width off centre."""
    speed, start_us = 3.5 if request.speed is None else request.speed, request.start_us
    chosen = request.chosen
    if len(chosen) < 2:
        raise PhysicsError("two vehicles in view are needed; name two or more with objects")
    count = len(chosen) // 2 if request.named else min(len(chosen) // 2, 2)
    if request.named:
        runners, standing = chosen[:count], chosen[count : 2 * count]
    else:
        visibilities = {s.object_id: visibility_of(request.scene, s) for s in chosen}
        runners = tuple(sorted(chosen, key=lambda s: -visibilities[s.object_id].front)[:count])
        rest = [s for s in chosen if s not in runners]
        standing = tuple(sorted(rest, key=lambda s: -visibilities[s.object_id].rear)[:count])
    objects: dict[str, ObjectPhysics] = {}
    midpoints = []
    placed: list[tuple[Float, Float]] = []
    if request.named and len(chosen) % 2:
        last = chosen[-1]
        pose = last.trajectory.transform(start_us)
        placed.append((pose, np.asarray(last.scaled_size)))
        objects[last.object_id] = ObjectPhysics(velocity=(0, 0, 0), T_world_object=pose)
    for k, (runner, hit) in enumerate(zip(runners, standing, strict=True)):
        own = runner.trajectory.transform(start_us)
        forward = level(own[:3, 0])
        away = _reach(request, runner)[1][0] + PAIR_GAP - _reach(request, hit)[0][0]
        target = np.array(own)
        target[:3, 3] += away * forward
        target[:3, 3] += (0.25 - 0.5 * (k % 2)) * hit.scaled_size[1] * np.cross([0, 0, 1], forward)
        target[2, 3] += (hit.scaled_size[2] - runner.scaled_size[2]) / 2
        sizes = np.asarray(runner.scaled_size), np.asarray(hit.scaled_size)
        shift = _lateral_shift([(own, sizes[0]), (target, sizes[1])], placed, forward)
        own, target = _moved(own, shift), _moved(target, shift)
        placed += [(own, sizes[0]), (target, sizes[1])]
        objects[runner.object_id] = ObjectPhysics(velocity=speed * forward, T_world_object=own)
        objects[hit.object_id] = ObjectPhysics(velocity=(0, 0, 0), T_world_object=target)
        midpoints.append((own[:3, 3] + target[:3, 3]) / 2)
    options = SimulateOptions(
        preset=request.preset,
        objects=objects,
        start_us=start_us,
        duration=PAIR_GAP / speed + 0.8,
        gravity=(0.0, 0.0, 0.0),
    )
    view = beside(request.scene, runners[0], runners[0].trajectory.transform(start_us))
    return Experiment(
        "pair",
        options,
        tuple(objects),
        midpoints[0],
        view,
        9.0,
        without=others_near(request, options, midpoints[0]),
    )


def _lateral_shift(
    pair: Sequence[tuple[Float, Float]], placed: Sequence[tuple[Float, Float]], forward: Float
) -> Float:
    """Shortest lateral shift [3] that separates a pair's boxes from all placed ones [m]."""
    side = np.cross([0.0, 0.0, 1.0], forward)
    for k in range(ASIDE_TRIES):
        shift: Float = ASIDE_STEP * ((k + 1) // 2) * (1 if k % 2 else -1) * side
        boxes = [(_moved(pose, shift), size + APART) for pose, size in pair]
        if not any(box_penetration(*box, *other) > 0 for box in boxes for other in placed):
            return shift
    raise PhysicsError(
        f"no place within {ASIDE_STEP * ASIDE_TRIES / 2:.0f} m for all pairs; name fewer objects"
    )


def _moved(pose: Float, shift: Float) -> Float:
    moved = np.array(pose)
    moved[:3, 3] += shift
    return moved


def _drop(request: Request) -> Experiment:
    start_us = request.start_us
    subjects = request.chosen if request.named else request.chosen[:3]
    objects = {}
    for subject in subjects:
        pose = subject.trajectory.transform(start_us)
        pose[2, 3] += DROP_HEIGHT
        down = (0.0, 0.0, -(request.speed or 0.0))
        objects[subject.object_id] = ObjectPhysics(
            T_world_object=pose,
            velocity=down,
            material=DAMPED if request.preset == "paper" else None,
        )
    options = SimulateOptions(
        preset=request.preset,
        objects=objects,
        colliders=[scene_road(request.scene, request.state, start_us)],
        start_us=start_us,
        duration=2.0,
    )
    shown = max(subjects, key=lambda s: abs(float(visibility_of(request.scene, s).direction[1])))
    pose = shown.trajectory.transform(start_us)
    view = viewer(request.scene, shown, pose, slant=2.6, rise=0.25)
    focus = pose[:3, 3] + np.array([0.0, 0.0, DROP_HEIGHT / 3])
    return Experiment("drop", options, tuple(objects), focus, view, 8.0)


def _reach(request: Request, subject: PlacedObject) -> tuple[Float, Float]:
    """Extent of an object's particles, backwards and forwards along its axes, [3] and [3] [m].

    Tracked boxes are less exact: particles extend up to a voxel beyond them.
    """
    preset = spaced_for(preset_of(request.preset), [subject])
    if request.grids:
        preset = replace(preset, spacing=max(subject.scaled_size) / max(request.grids))
    particles = object_particles(request.scene, subject, preset, request.start_us).positions
    return particles.min(axis=0) - preset.spacing / 2, particles.max(axis=0) + preset.spacing / 2
