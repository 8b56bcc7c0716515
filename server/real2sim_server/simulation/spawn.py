"""Creation of bodies from scenario objects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch

from ..geometry import (
    Float,
    apply_transform,
    box_penetration,
    is_rigid,
    quaternion_to_matrix,
)
from ..physics.body import Particles
from ..physics.colliders import Collider, Solid, TriangleMesh
from ..physics.errors import PhysicsError
from ..scene import GaussianCloud, Scene, SceneObject, Trajectory
from .body import DeformableBody
from .particles import fill_object, stretched
from .rebound import fit_rebound
from .result import PlacedObject, PlacedObjects
from .rigid import clearance
from .structure import VEHICLES, ObjectPhysics, Preset, centre_height
from .tyres import Tyres, track_of

# --- Ego ------------------------------------------------------------------------------------------

# Recordings do not show the ego, so it is a generic car of its size, made of Gaussians: bonnet,
# cabin with dark glass, wheels. Its box follows the recorded rear axle.

EGO = "ego"
"""Id of the ego as an object of a simulation."""
REAR_OVERHANG = 0.95
"""Distance from the rear axle to the rear end of its box [m], as in the closed loop."""
STEP = 0.07
"""Spacing of Gaussians over its surface [m]."""
PAINT, GLASS, RUBBER, LAMP = (0.16, 0.27, 0.42), (0.05, 0.06, 0.08), (0.03,) * 3, (0.75, 0.74, 0.68)
SILL, BELT, BONNET = 0.17, 0.58, 0.60
"""Heights of the underside, of the lower edge of the windows and of the bonnet, as fractions of the
vehicle's height."""
ROOFLINE = np.array(
    [[0.0, 0.62], [0.02, 0.66], [0.14, 0.72], [0.3, 0.98], [0.42, 1.0], [0.58, 0.97], [0.74, 0.66],
     [0.97, 0.57], [1.0, 0.5]]
)  # fmt: skip
"""Side profile: fractions of the length from the rear, and of the height."""
WHEEL = 0.33
"""Radius of its wheels [m]."""
SH_DC = 0.28209479177387814


@dataclass(frozen=True, eq=False)
class PlacedEgo:
    """The ego among a scenario's objects; see ``PlacedObject``."""

    scaled_size: tuple[float, float, float]
    trajectory: Trajectory
    instance_id: int
    object_id: str = EGO
    source_id: str = EGO
    category: str = "car"
    scale: tuple[float, float, float] = (1.0, 1.0, 1.0)


@dataclass(frozen=True, eq=False)
class WithEgo:
    """A scenario's objects and the ego.

    Attributes:
        visible: all visible objects, the ego last.
    """

    visible: tuple[PlacedObject, ...]


def with_ego(scene: Scene, state: PlacedObjects) -> tuple[Scene, PlacedObjects]:
    """A scene and its objects including the ego; unchanged if an object already has its id."""
    if any(o.object_id == EGO for o in state.visible):
        return scene, state
    trajectory = _boxes(scene.ego, scene.ego_size)
    instance = 1 + max((o.instance_id for o in state.visible), default=0)
    own = SceneObject(EGO, "car", scene.ego_size, ego_cloud(scene.ego_size), trajectory)
    complete = replace(scene, objects={**scene.objects, EGO: own.to(scene.background.device)})
    placed = PlacedEgo(scene.ego_size, trajectory, instance)
    return complete, WithEgo((*state.visible, placed))


def _boxes(ego: Trajectory, size: tuple[float, float, float]) -> Trajectory:
    """Poses of the ego's box, from those of its rear axle on the ground."""
    ahead = np.array([size[0] / 2 - REAR_OVERHANG, 0.0, size[2] / 2])
    shift = quaternion_to_matrix(ego.quaternions) @ ahead
    return Trajectory(ego.times_us, ego.positions + shift, ego.quaternions)


@lru_cache(maxsize=4)
def ego_cloud(size: tuple[float, float, float]) -> GaussianCloud:
    """Surface Gaussians of a generic car of this size [m], box frame."""
    length, _, height = size
    along = _ticks(length)
    top = height * np.interp(along / length, ROOFLINE[:, 0], ROOFLINE[:, 1])
    parts = [
        *(_side(along, top, size, sign) for sign in (-1.0, 1.0)),
        _upper(along, top, size),
        _end(top[0], size, rear=True),
        _end(top[-1], size, rear=False),
        *(_wheel(size, x, y) for x in (-0.3, 0.3) for y in (-1.0, 1.0)),
    ]
    points = np.concatenate([p for p, _ in parts]).astype(np.float32)
    colours = np.concatenate([c for _, c in parts]).astype(np.float32)
    n = len(points)
    return GaussianCloud(
        means=torch.from_numpy(points),
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1),
        scales=torch.full((n, 3), 0.65 * STEP),
        opacities=torch.full((n,), 0.95),
        sh=torch.from_numpy((colours - 0.5) / SH_DC)[:, None],
    )


def _ticks(extent: float) -> Float:
    """Evenly spaced positions from 0 to an extent, ends included [m]."""
    return np.linspace(0.0, extent, max(round(extent / STEP), 2) + 1)


def _coloured(points: Float, rgb: tuple[float, ...]) -> tuple[Float, Float]:
    return points, np.tile(np.array(rgb), (len(points), 1))


def _narrowing(z: Float, size: tuple[float, float, float]) -> Float:
    """Fraction of the width at heights above the underside of the box: windows lean inwards."""
    return 1.0 - 0.18 * np.clip(z / size[2] - BELT, 0.0, 1.0) / (1.0 - BELT)


def _side(
    along: Float, top: Float, size: tuple[float, float, float], sign: float
) -> tuple[Float, Float]:
    length, width, height = size
    x, z = np.meshgrid(along, _ticks(height), indexing="ij")
    kept = (z > SILL * height) & (z <= top[:, None])
    for axle in (-0.3, 0.3):
        kept &= np.hypot(x - length / 2 - axle * length, z - WHEEL) > WHEEL
    x, z = x[kept], z[kept]
    y = sign * width / 2 * _narrowing(z, size)
    points = np.stack([x - length / 2, y, z - height / 2], axis=1)
    colours = np.tile(np.array(PAINT), (len(points), 1))
    pillar = np.abs(x / length - 0.46) < 0.012
    roof = z > np.interp(x, along, top) - STEP
    colours[(z > BELT * height + STEP) & ~pillar & ~roof] = GLASS
    return points, colours


def _upper(along: Float, top: Float, size: tuple[float, float, float]) -> tuple[Float, Float]:
    """Bonnet, windscreens and roof."""
    length, width, height = size
    x, v = np.meshgrid(along, _ticks(width) / width - 0.5, indexing="ij")
    z = np.broadcast_to(top[:, None], x.shape)
    y = v * width * _narrowing(z, size)
    points = np.stack([x - length / 2, y, z - height / 2], axis=-1).reshape(-1, 3)
    steep = np.abs(np.gradient(top, along)) > 0.5
    glass = steep & (top > BONNET * height) & (along > 0.08 * length) & (along < 0.8 * length)
    colours = np.tile(np.array(PAINT), (len(points), 1))
    colours[np.repeat(glass, x.shape[1])] = GLASS
    return points, colours


def _end(top: float, size: tuple[float, float, float], *, rear: bool) -> tuple[Float, Float]:
    length, width, height = size
    y, z = np.meshgrid(_ticks(width) - width / 2, _ticks(top), indexing="ij")
    kept = z > SILL * height
    y, z = y[kept], z[kept]
    x = np.full(len(y), -length / 2 if rear else length / 2)
    colours = np.tile(np.array(PAINT), (len(y), 1))
    lamps = (np.abs(y) > 0.32 * width) & (z > 0.36 * height) & (z < 0.48 * height)
    colours[lamps] = (0.5, 0.04, 0.04) if rear else LAMP
    colours[z < 0.26 * height] = RUBBER
    return np.stack([x, y, z - height / 2], axis=1), colours


def _wheel(size: tuple[float, float, float], axle: float, side: float) -> tuple[Float, Float]:
    length, width, height = size
    u, w, v = np.meshgrid(
        _ticks(2 * WHEEL) - WHEEL, _ticks(0.2), _ticks(2 * WHEEL) - WHEEL, indexing="ij"
    )
    kept = np.hypot(u, v) <= WHEEL
    y = side * (width / 2 - w[kept])
    points = np.stack([u[kept] + axle * length, y, v[kept] + WHEEL - height / 2], axis=1)
    return _coloured(points, RUBBER)


SPEED_MAX = 200.0
"""Maximum speed [m/s]; faster bodies would pass through others within a step."""
SPIN_MAX = 100.0
"""Maximum angular speed [rad/s]."""
MIN_PARTICLES_ACROSS = 4.0
"""Minimum number of particles across the shortest side of a body that deforms."""
PENETRATION_MAX = 0.3
"""Maximum initial penetration [m]; deeper bodies were placed by mistake."""
VOLUME_SPACING, VOXELS_MAX = 0.05, 1_000_000
"""Edge of the voxels for measuring volume [m], and their maximum number per box."""
OVERLAP_FRACTION = 0.01
"""Bodies overlap if this fraction of one body's particles is among the particles of the other."""


def spawn_bodies(
    scene: Scene,
    state: PlacedObjects,
    wanted: Mapping[str, ObjectPhysics],
    *,
    preset: Preset,
    start_us: int,
    colliders: Sequence[Collider],
    road: Sequence[str],
    gravity: Float,
    max_particles: int,
) -> list[DeformableBody]:
    """A body for each requested object, in its start state.

    Raises:
        PhysicsError: for an object that is absent at ``start_us``, for overlapping objects, and the
            errors of ``fill_object``.
    """
    subjects = _subjects(state, wanted, start_us)
    preset = filled_as_wanted(preset, subjects, list(wanted.values()), max_particles)
    bodies = [
        _spawn_body(
            scene,
            subject,
            physics,
            preset,
            start_us,
            colliders=colliders,
            road=road,
            gravity=gravity,
        )
        for subject, physics in zip(subjects, wanted.values(), strict=True)
    ]
    boxes = [(a.T_world_object, s.scaled_size) for a, s in zip(bodies, subjects, strict=True)]
    require_separation(bodies, boxes, [c for c in colliders if c.name not in road])
    return bodies


@dataclass(frozen=True, eq=False)
class Start:
    """Start pose and velocity of an object.

    Attributes:
        T_world_object: [4, 4].
        size: (length, width, height) of its box [m].
        velocity: [3] [m/s].
    """

    T_world_object: Float
    size: tuple[float, float, float]
    velocity: Float


def starts_of(
    state: PlacedObjects, wanted: Mapping[str, ObjectPhysics], start_us: int
) -> list[Start]:
    """Start of each requested object. Raises like :func:`spawn_bodies`."""
    subjects = _subjects(state, wanted, start_us)
    return [
        Start(
            _pose(subject, physics, start_us),
            subject.scaled_size,
            _velocities(subject, physics, start_us)[0],
        )
        for subject, physics in zip(subjects, wanted.values(), strict=True)
    ]


def _subjects(
    state: PlacedObjects, wanted: Mapping[str, ObjectPhysics], start_us: int
) -> list[PlacedObject]:
    there = {o.object_id: o for o in state.visible}
    subjects = []
    for object_id, physics in wanted.items():
        if object_id not in there:
            raise PhysicsError(f"no object {object_id!r} to simulate; there are {sorted(there)}")
        subject = there[object_id]
        if physics.T_world_object is None and not subject.trajectory.covers(start_us):
            raise PhysicsError(
                f"object {object_id!r} does not exist at {start_us} us; it exists from "
                f"{subject.trajectory.start_us} to {subject.trajectory.end_us} us"
            )
        subjects.append(subject)
    return subjects


def filled_as_wanted(
    preset: Preset,
    subjects: Sequence[PlacedObject],
    wanted: Sequence[ObjectPhysics],
    most: int = 10**12,
) -> Preset:
    """The preset with the particle spacing of the finest requested grid.

    Raises:
        PhysicsError: for a grid that is too coarse for an object or needs more than ``most``
            particles.
    """
    asked = [
        (max(s.scaled_size) / w.grid, s.object_id, w.grid)
        for s, w in zip(subjects, wanted, strict=True)
        if w.grid is not None
    ]
    if not asked:
        return _limit_particles(preset, subjects, most)
    spacing, finest, grid = min(asked)
    sizes = np.array([s.scaled_size for s in subjects])
    needed = int(np.ceil(sizes.prod(axis=1).sum() / spacing**3))
    if needed > most:
        raise PhysicsError(
            f"grid {grid} of {finest!r} puts particles {spacing:.2g} m apart: {needed:,} of them, "
            f"more than {most:,}; take a smaller grid, fewer objects, or raise max_particles"
        )
    for subject, size in zip(subjects, sizes, strict=True):
        if size.min() < MIN_PARTICLES_ACROSS * spacing:
            raise PhysicsError(
                f"grid {grid} of {finest!r} puts particles {spacing:.2g} m apart, too coarse for "
                f"{subject.object_id!r} of {size.min():.2g} m; take a larger grid"
            )
    return replace(preset, spacing=spacing)


def _limit_particles(preset: Preset, subjects: Sequence[PlacedObject], most: int) -> Preset:
    """The preset with a spacing at which full boxes hold at most ``most`` particles."""
    preset = spaced_for(preset, subjects)
    sizes = np.array([s.scaled_size for s in subjects])
    spacing = max(preset.spacing, float(np.cbrt(sizes.prod(axis=1).sum() / most)))
    needed = int(np.ceil(sizes.prod(axis=1).sum() / preset.spacing**3))
    for subject, size in zip(subjects, sizes, strict=True):
        if spacing > preset.spacing and size.min() < MIN_PARTICLES_ACROSS * spacing:
            raise PhysicsError(
                f"{len(subjects)} objects would take {needed:,} particles {preset.spacing} m "
                f"apart; {most:,} of them are {spacing:.2g} m apart, too coarse for "
                f"{subject.object_id!r} of {size.min():.2g} m: simulate fewer objects, or raise "
                "max_particles"
            )
    return replace(preset, spacing=spacing)


def spaced_for(preset: Preset, subjects: Sequence[PlacedObject]) -> Preset:
    """The preset with the particle spacing that these objects need."""
    if all(subject.category in VEHICLES for subject in subjects):
        return replace(preset, spacing=preset.vehicle_spacing)
    return preset


def require_separation(
    bodies: Sequence[DeformableBody],
    boxes: Sequence[tuple[Float, Sequence[float]]],
    colliders: Sequence[Collider],
) -> None:
    """Check that no bodies overlap each other or a collider at the start.

    Overlaps below PENETRATION_MAX, as between tracked boxes of parked cars, are left to contact.

    Args:
        bodies: bodies.
        boxes: pose [4, 4] and size of each body; particles may extend slightly beyond.
        colliders: colliders that do not support tyres.

    Raises:
        PhysicsError: for overlaps, with the names.
    """
    for k, a in enumerate(bodies):
        for b, box in list(zip(bodies, boxes, strict=True))[k + 1 :]:
            depth = float(box_penetration(*boxes[k], *box))
            # Boxes may overlap at corners without particles.
            if depth > PENETRATION_MAX and _particles_overlap(a, b):
                raise PhysicsError(
                    f"objects {a.name!r} and {b.name!r} are {depth:.2f} m inside each other at the "
                    "start; move one, or leave one out"
                )
        for collider in colliders:
            depth = _depth_inside(a, collider)
            if depth > PENETRATION_MAX:
                raise PhysicsError(
                    f"object {a.name!r} is {depth:.2f} m inside collider {collider.name!r} at the "
                    "start; move one, or leave one out"
                )


def _depth_inside(body: DeformableBody, collider: Collider) -> float:
    """Distance to move a body out of a collider [m]; at most 0 if it is outside.

    Particles are never deep inside a thin post, so for solids with a particle inside this is the
    overlap with their bounding box, and for meshes the shorter distance from the contact point.
    """
    depth = -body.gap_to_colliders([collider])[0]
    if not isinstance(collider, Solid):
        return depth
    points = apply_transform(body.T_world_object, body.shape.positions)
    distance, normals = clearance(collider, points)
    if depth <= 0 and float(distance.min()) > body.spacing / 2:
        return depth
    if isinstance(collider, TriangleMesh):
        nearest = int(distance.argmin())
        along = (points - points[nearest]) @ normals[nearest]
        return max(depth, min(float(along.max()), -float(along.min())))
    pose, (low, high) = np.array(collider.pose), collider.bounds
    pose[:3, 3] += pose[:3, :3] @ ((low + high) / 2)
    return float(box_penetration(*body.box(), pose, high - low))


def _particles_overlap(a: DeformableBody, b: DeformableBody) -> bool:
    from scipy.spatial import cKDTree

    own = apply_transform(a.T_world_object, a.shape.positions)
    other = apply_transform(b.T_world_object, b.shape.positions)
    near, _ = cKDTree(other).query(own, distance_upper_bound=a.spacing)
    return int(np.isfinite(near).sum()) > OVERLAP_FRACTION * len(own)


def _spawn_body(
    scene: Scene,
    subject: PlacedObject,
    physics: ObjectPhysics,
    preset: Preset,
    start_us: int,
    *,
    colliders: Sequence[Collider],
    road: Sequence[str],
    gravity: Float,
) -> DeformableBody:
    particles = object_particles(scene, subject, preset, start_us, mass=physics.mass)
    if physics.material is None:
        materials, regions, particles = preset.build(subject.category, particles, preset.spacing)
    else:
        materials, regions = (physics.material,), np.zeros(len(particles), dtype=np.int64)
    # The structure has moved mass between its zones.
    particles = _with_centre(particles, subject, preset)
    density = physics.density
    if density is None and preset.by_density:
        density = materials[0].density
    if density is not None and physics.mass is None:
        particles = particles.with_mass(density * object_volume(scene, subject, start_us))
    pose = _pose(subject, physics, start_us)
    velocity, spin = _velocities(subject, physics, start_us)
    tyres = None
    if preset.wheels and subject.category in VEHICLES:
        moving = float(np.linalg.norm(velocity)) >= 0.1
        tyres = _tyres(subject, particles, gravity, brake=_brake(physics, moving))
        tyres = tyres.standing(pose, [c for c in colliders if c.name in road])
    body = DeformableBody(
        subject.object_id,
        particles,
        materials,
        regions,
        friction=preset.friction if physics.friction is None else physics.friction,
        cell=2 * preset.spacing,
        T_world_object=pose,
        velocity=velocity,
        angular_velocity=spin,
        tyres=tyres,
    )
    if physics.restitution is not None:
        met = [c for c in colliders if tyres is None or c.name not in road]
        # A body on wheels rolls, regardless of gravity.
        pull = gravity if tyres is None else np.zeros(3)
        body.rebound = fit_rebound(body, physics.restitution, met, pull)
    return body


def object_particles(
    scene: Scene, subject: PlacedObject, preset: Preset, start_us: int, *, mass: float | None = None
) -> Particles:
    """Particles of an object, object frame, without the space between the wheels.

    A vehicle on wheels gets the height of the centre of mass of its class.

    Raises:
        ParticleError: as ``fill_object``.
    """
    size = subject.scaled_size
    cloud = stretched(scene.object(subject.source_id).cloud_at(start_us), subject.scale)
    filling = fill_object(cloud, size, spacing=preset.spacing, mass=mass, category=subject.category)
    if not (preset.wheels and subject.category in VEHICLES):
        return filling.lattice()
    particles = filling.lattice(above=-size[2] / 2 + preset.clearance)
    return _with_centre(particles, subject, preset)


def _with_centre(particles: Particles, subject: PlacedObject, preset: Preset) -> Particles:
    """Particles with the centre of mass height of the vehicle's class, for vehicles on wheels."""
    size = subject.scaled_size
    if not (preset.wheels and subject.category in VEHICLES):
        return particles
    height = centre_height(subject.category, track_of(size))
    return particles if height is None else particles.with_centre_height(height - size[2] / 2)


def object_volume(scene: Scene, subject: PlacedObject, start_us: int) -> float:
    """Filled volume of an object [m^3], with voxels that depend on its size only.

    Surface voxels extend beyond the object by half a voxel, so coarser voxels have more volume.

    Raises:
        ParticleError: as ``fill_object``.
    """
    size = subject.scaled_size
    spacing = max(VOLUME_SPACING, float(np.cbrt(np.prod(size) / VOXELS_MAX)))
    cloud = stretched(scene.object(subject.source_id).cloud_at(start_us), subject.scale)
    filling = fill_object(cloud, size, spacing=spacing, category=subject.category)
    return float(filling.lattice().volumes.sum())


def _pose(subject: PlacedObject, physics: ObjectPhysics, start_us: int) -> Float:
    if physics.T_world_object is None:
        return subject.trajectory.transform(start_us)
    pose = np.array(physics.T_world_object, dtype=np.float64)
    if not is_rigid(pose):
        raise PhysicsError(f"T_world_object of {subject.object_id!r} must be rigid: {pose!r}")
    return pose


def _velocities(
    subject: PlacedObject, physics: ObjectPhysics, start_us: int
) -> tuple[Float, Float]:
    """Initial velocity [m/s] and angular velocity [rad/s], as given or as recorded."""
    recorded = subject.trajectory.velocity(start_us) if physics.velocity is None else None
    velocity = _vector(physics.velocity, recorded, f"velocity of {subject.object_id!r}", SPEED_MAX)
    name = f"angular_velocity of {subject.object_id!r}"
    return velocity, _vector(physics.angular_velocity, np.zeros(3), name, SPIN_MAX)


def _brake(physics: ObjectPhysics, moving: bool) -> float:
    return physics.brake if physics.brake is not None else float(not moving)


def _tyres(subject: PlacedObject, particles: Particles, gravity: Float, *, brake: float) -> Tyres:
    weight = particles.mass * float(np.linalg.norm(gravity))
    centre = particles.centre_of_mass
    return Tyres.of(subject.scaled_size, centre, max(weight, 1e-6), brake=brake)


def _vector(given: object, otherwise: Float | None, name: str, most: float) -> Float:
    """The given vector [3] or the default; raises if its length exceeds ``most``."""
    vector = np.array(otherwise if given is None else given, dtype=np.float64)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise PhysicsError(f"{name} must be 3 finite numbers, not {given!r}")
    if float(np.linalg.norm(vector)) > most:
        unit = "rad/s" if most == SPIN_MAX else "m/s"
        raise PhysicsError(
            f"{name} is {vector.tolist()} {unit}; at most {most:g} {unit} is allowed"
        )
    return vector
