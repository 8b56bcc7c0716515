"""Experiments set up on the vehicles of a scene: the paper's three, and crash tests."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ...geometry.box import box_penetration
from ...geometry.rotation import Float
from ...physics.colliders import Collider, Plane
from ...physics.errors import PhysicsError
from ...physics.materials import FixedCorotated
from ...scene import Scene
from ..playback import PlacedObject, PlacedObjects
from ..presets import ObjectPhysics, preset_of
from ..rollout import SimulateOptions
from ..spawn import object_particles, spaced_for
from ..structure import VEHICLES
from .crashes import CRASHES
from .setup import Experiment, Request, beside, level, others_near, scene_road, viewer
from .viewing import in_view, visibility_of

WALL_GAP = 0.5
"""Between the vehicle and the wall at the start [m]: contact after 1 s at 0.5 m/s."""
DROP_HEIGHT = 1.225
"""Free fall of 0.5 s [m]."""
DAMPED = FixedCorotated(young=2e6, poisson=0.4, density=200.0, viscosity=1.5e4)
"""The paper's medium for the fall. Its table has no damping, with which a block of this size jumps
back up by a third of the height; this much leaves a slight bounce."""
PAIR_GAP = 1.5
"""Between the vehicles that collide [m]: contact after 0.43 s at 3.5 m/s."""
APART, ASIDE_STEP, ASIDE_TRIES = 0.4, 0.5, 400
"""Room between pairs that collide, steps in which one is moved aside for it, and how many [m]."""
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
    """An experiment on a scene.

    Args:
        name: ``wall``: one vehicle against a virtual wall; ``pair``: vehicles into as many standing
            ones, without gravity; ``drop``: vehicles raised and let fall on the extracted ground;
            ``frontal``, ``t_bone``, ``pole``, ``roof``: see ``crashes``.
        preset: of the materials; ``paper`` for its experiments and ``vehicle`` for crashes unless
            told.
        speed: [m/s]; the experiment's own by default.
        objects: ids to take; by default vehicles in view, those seen best where it hits. For
            ``pair`` any number from two on: the first half runs into the others, and of an odd
            number the last one stands where it is.
        start_us: [us]; the first frame by default.
        grids: that will be asked for, see ``ObjectPhysics.grid``: how far particles reach out.

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
    """Vehicles before the first camera, the largest on its image first."""
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
    # What is to be crushed must have been seen.
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
"""In the paper's preset a vehicle has no wheels; that it rolls means it slides freely."""


def _standing_road(request: Request, subject: PlacedObject) -> Collider:
    """The road; without wheels it must not reach into the vehicle's underside."""
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
    """Two vehicles start behind standing ones, half a width off centre, as traffic hits."""
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
        shift = _way_aside([(own, sizes[0]), (target, sizes[1])], placed, forward)
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


def _way_aside(
    pair: Sequence[tuple[Float, Float]], placed: Sequence[tuple[Float, Float]], forward: Float
) -> Float:
    """Shortest way [3] sideways that frees the boxes of a pair of all that are placed [m]."""
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
    """How far an object's particles reaches back and forth along its own axes, [3] and [3] [m].

    Tracked boxes are not that exact: particles reaches up to a voxel out of them.
    """
    preset = spaced_for(preset_of(request.preset), [subject])
    if request.grids:
        preset = replace(preset, spacing=max(subject.scaled_size) / max(request.grids))
    particles = object_particles(request.scene, subject, preset, request.start_us).positions
    return particles.min(axis=0) - preset.spacing / 2, particles.max(axis=0) + preset.spacing / 2
