"""A procedural street of Gaussians for benchmarks of the renderer.

It resembles a street initialised from LiDAR: one disc per occupied voxel of 0.15 m, flat along the
surface and overlapping its neighbours, with noise in position, size and colour.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from ..geometry import matrix_to_quaternion, transform_from, yaw_quaternion
from ..render.types import Instance
from ..scene import Camera, CameraRig, GaussianCloud, Scene, SceneObject, Sky, Trajectory
from ..scene.camera import T_VEHICLE_OPTICAL

Float = NDArray[np.float64]
SPACING = 0.15
ROAD_WIDTH, PAVEMENT_WIDTH, FACADE_HEIGHT = 14.0, 4.0, 15.0
CAR_SIZE = np.array([4.4, 1.8, 1.5])
CARS, TREE_EVERY, CROWN_RADIUS = 24, 12.0, 2.4
SH_C0 = 0.28209479177387814


@dataclass(frozen=True, eq=False)
class StreetSurfels:
    """Discs: centres [N, 3] [m], unit normals [N, 3], colours [N, 3] in [0, 1]."""

    centres: Float
    normals: Float
    colors: Float


@dataclass(frozen=True, eq=False)
class StreetScene:
    """Result of street_scene(): rendered by ``rasterize(instances, ...)`` from ``camera``."""

    instances: list[Instance]
    sky: Sky
    camera: Camera
    T_world_vehicle: Float

    @property
    def gaussian_count(self) -> int:
        """Number of rendered Gaussians; shared clouds count once per instance."""
        return sum(len(instance.cloud) for instance in self.instances)


def street_scene(
    count: int = 1_000_000, *, width: int = 960, height: int = 640, seed: int = 0
) -> StreetScene:
    """A straight street along x with exactly ``count`` Gaussians, including cars.

    Args:
        count: at least 100,000; a larger number makes the street longer.
        width, height: image size of the camera [px]; its horizontal field of view is 56 degrees.
        seed: seed of all noise.
    """
    rng = np.random.default_rng(seed)
    car = surfels_to_cloud(car_surfels(rng), rng)
    for_background = count - CARS * len(car)
    length = 40.0
    background = background_surfels(rng, length)
    length *= 1.02 * for_background / len(background.centres)
    background = background_surfels(rng, length)
    kept = rng.permutation(len(background.centres))[:for_background]
    background = StreetSurfels(*(part[kept] for part in vars(background).values()))
    focal = 900.0 * width / 960
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    mount = T_VEHICLE_OPTICAL.copy()
    mount[:3, 3] = (1.5, 0, 1.6)
    return StreetScene(
        instances=[Instance(surfels_to_cloud(background, rng)), *parked_cars(car, length)],
        sky=Sky(torch.tensor([0.55, 0.7, 0.9]).expand(6, 64, 64, 3).contiguous()),
        camera=Camera("front", width, height, K, mount),
        T_world_vehicle=np.eye(4),
    )


def background_surfels(rng: np.random.Generator, length: float) -> StreetSurfels:
    """Road, pavements, facades and trees from x = -10 m to ``length`` - 10 m."""
    side = ROAD_WIDTH / 2 + PAVEMENT_WIDTH
    parts = [road(rng, length)]
    for sign in (-1.0, 1.0):
        y0 = sign * ROAD_WIDTH / 2
        pavement = patch([-10, y0, 0.12], [length, 0, 0], [0, sign * PAVEMENT_WIDTH, 0])
        parts.append(painted(pavement, rng, (0.55, 0.54, 0.52), 0.05))
        parts.append(facade(rng, length, sign * side))
        for x in np.arange(-6.0, length - 12, TREE_EVERY):
            parts.append(tree(rng, np.array([x, sign * (ROAD_WIDTH / 2 + 1.5), 0])))
    return joined(parts)


def road(rng: np.random.Generator, length: float) -> StreetSurfels:
    """Asphalt with a dashed line in the middle and a solid one on each side."""
    plane = patch([-10, -ROAD_WIDTH / 2, 0], [length, 0, 0], [0, ROAD_WIDTH, 0])
    plane = painted(plane, rng, (0.23, 0.23, 0.25), 0.03)
    x, y = plane.centres[:, 0], plane.centres[:, 1]
    line = (np.abs(y) < 0.12) & (x % 9 < 4) | (np.abs(np.abs(y) - 6.5) < 0.1)
    return StreetSurfels(plane.centres, plane.normals, np.where(line[:, None], 0.85, plane.colors))


def facade(rng: np.random.Generator, length: float, y: float) -> StreetSurfels:
    """Houses of different colours with rows of dark windows, facing the street."""
    wall = patch([-10, y, 0], [length, 0, 0], [0, 0, FACADE_HEIGHT])
    x, z = wall.centres[:, 0], wall.centres[:, 2]
    houses = rng.uniform(0.35, 0.85, (int(length / 12) + 3, 3))
    colors = houses[((x + 10) // 12).astype(int)]
    window = (x % 3 > 1) & (x % 3 < 2.2) & (z % 3.2 > 1) & (z % 3.2 < 2.6)
    colors = np.where(window[:, None], (0.12, 0.16, 0.22), colors)
    colors = colors + rng.normal(0, 0.03, colors.shape)
    return StreetSurfels(wall.centres, wall.normals, colors.clip(0, 1))


def tree(rng: np.random.Generator, foot: Float) -> StreetSurfels:
    """A trunk, and leaves throughout a ball."""
    angles, heights = rng.uniform(0, 2 * np.pi, 120), rng.uniform(0, 3, 120)
    outwards = np.stack([np.cos(angles), np.sin(angles), np.zeros(120)], -1)
    trunk = StreetSurfels(
        foot + 0.18 * outwards + np.stack([0 * heights, 0 * heights, heights], -1),
        outwards,
        np.full((120, 3), (0.3, 0.22, 0.15)),
    )
    normals = unit(rng.normal(size=(2000, 3)))
    radii = CROWN_RADIUS * rng.uniform(0.4, 1, (2000, 1))
    leaves = StreetSurfels(
        foot + np.array([0, 0, 4.6]) + radii * unit(rng.normal(size=(2000, 3))),
        normals,
        np.array([0.2, 0.35, 0.12]) * rng.uniform(0.5, 1.4, (2000, 1)),
    )
    return joined([trunk, leaves])


def car_surfels(rng: np.random.Generator) -> StreetSurfels:
    """The shell of a car, with the origin at its centre: five sides of a body and of a cabin."""
    body = shell(np.array([0, 0, -0.25]), CAR_SIZE * (1, 1, 0.6))
    cabin = shell(np.array([-0.2, 0, 0.45]), CAR_SIZE * (0.5, 0.85, 0.4))
    return joined(
        [painted(body, rng, (0.6, 0.1, 0.1), 0.03), painted(cabin, rng, (0.1, 0.12, 0.15), 0.03)]
    )


def shell(centre: Float, size: Float) -> StreetSurfels:
    """All sides of a box except the bottom."""
    low, (a, b, c) = centre - size / 2, np.diag(size)
    return joined(
        [
            patch(low, b, c),
            patch(low + a, b, c),
            patch(low, a, c),
            patch(low + b, a, c),
            patch(low + c, a, b),
        ]
    )


def parked_cars(car: GaussianCloud, length: float) -> list[Instance]:
    """Instances of one cloud at both kerbs, some in the opposite direction."""
    places = np.linspace(4, min(length - 20, 120), CARS // 2)
    instances = []
    for index in range(CARS):
        sign = 1 if index % 2 else -1
        position = [places[index // 2], sign * (ROAD_WIDTH / 2 - 1.2), CAR_SIZE[2] / 2]
        pose = transform_from(position, yaw_quaternion(0.03 * index + np.pi * (sign > 0)))
        instances.append(Instance(car, pose, 1 + index))
    return instances


def patch(
    corner: Float | list[float], u: Float | list[float], v: Float | list[float]
) -> StreetSurfels:
    """Discs on a grid of SPACING over the parallelogram ``corner + [0, 1] u + [0, 1] v``."""
    start, along, across = (np.asarray(value, dtype=np.float64) for value in (corner, u, v))
    steps = [max(1, round(np.linalg.norm(edge) / SPACING)) for edge in (along, across)]
    s, t = np.meshgrid(*((np.arange(n) + 0.5) / n for n in steps), indexing="ij")
    centres = start + s.reshape(-1, 1) * along + t.reshape(-1, 1) * across
    normal = unit(np.cross(along, across))
    return StreetSurfels(centres, np.broadcast_to(normal, centres.shape), np.zeros_like(centres))


def painted(
    surfels: StreetSurfels, rng: np.random.Generator, rgb: tuple[float, float, float], noise: float
) -> StreetSurfels:
    """The same discs in one colour with noise."""
    colors = np.array(rgb) + rng.normal(0, noise, surfels.centres.shape)
    return StreetSurfels(surfels.centres, surfels.normals, colors.clip(0, 1))


def joined(parts: list[StreetSurfels]) -> StreetSurfels:
    """All discs concatenated."""
    columns = zip(*(vars(part).values() for part in parts), strict=True)
    return StreetSurfels(*(np.concatenate(column) for column in columns))


def surfels_to_cloud(surfels: StreetSurfels, rng: np.random.Generator) -> GaussianCloud:
    """Discs as Gaussians with spherical harmonics of degree 1."""
    n = len(surfels.centres)
    sh = np.zeros((n, 4, 3))
    sh[:, 0] = (surfels.colors - 0.5) / SH_C0
    sh[:, 1:] = rng.normal(0, 0.03, (n, 3, 3))
    scales = np.stack([np.full(n, 0.02), *(rng.uniform(0.5, 0.8, (2, n)) * SPACING)], -1)
    arrays = (
        surfels.centres + rng.normal(0, 0.03, (n, 3)),
        matrix_to_quaternion(frames_of(surfels.normals)),
        scales,
        rng.uniform(0.6, 0.98, n),
        sh,
    )
    return GaussianCloud(*(torch.from_numpy(array.astype(np.float32)) for array in arrays))


def frames_of(normals: Float) -> Float:
    """Rotations [N, 3, 3] whose first column is the normal."""
    helper = np.where(np.abs(normals[:, 2:]) < 0.9, (0.0, 0, 1), (1.0, 0, 0))
    second = unit(np.cross(helper, normals))
    return np.stack([normals, second, np.cross(normals, second)], -1)


def unit(vectors: Float) -> Float:
    """Vectors [..., 3] scaled to length 1."""
    scaled: Float = vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
    return scaled


# The street as a scene with a drive.

SPEED = 8.0
SECONDS = 20
PERIOD_US = 100_000


def street(name: str, *, gaussians: int, width: int, height: int) -> Scene:
    """A straight street with parked cars; the ego drives along it at 8 m/s for 20 s.

    Args:
        name: name of the scene.
        gaussians: total number, including parked cars.
        width, height: image size of its only camera, ``front`` [px].
    """
    made = street_scene(gaussians, width=width, height=height)
    times = np.arange(0, SECONDS * 1_000_000 + 1, PERIOD_US)
    positions = np.zeros((len(times), 3))
    positions[:, 0] = SPEED * times * 1e-6
    upright = np.tile([1.0, 0.0, 0.0, 0.0], (len(times), 1))
    return Scene(
        name=name,
        background=made.instances[0].cloud,
        objects={o.object_id: o for o in _parked_cars(made, times[[0, -1]])},
        sky=made.sky,
        rig=CameraRig((made.camera,)),
        ego=Trajectory(times, positions, upright),
        frame_times_us=times,
        provenance={"source": "procedural street of the benches"},
    )


def _parked_cars(made: StreetScene, times: np.ndarray) -> list[SceneObject]:
    cars = []
    for instance in made.instances[1:]:
        pose = instance.T_world_object
        assert pose is not None
        quaternion = matrix_to_quaternion(pose[None, :3, :3])
        trajectory = Trajectory(times, np.tile(pose[:3, 3], (2, 1)), np.tile(quaternion, (2, 1)))
        length, width, height = CAR_SIZE.tolist()
        name = f"car_{instance.instance_id}"
        cars.append(SceneObject(name, "car", (length, width, height), instance.cloud, trajectory))
    return cars
