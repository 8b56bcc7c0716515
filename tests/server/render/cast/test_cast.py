"""Ray casting against closed-form ranges and the plain reference."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

import numba
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from real2sim_server.geometry import transform_from, yaw_quaternion
from real2sim_server.render import Instance, RenderError
from real2sim_server.render.cast import Echo, cast
from real2sim_server.scene import Beams, GaussianCloud, Lidar

Array = NDArray[np.float64]
ROWS = np.radians(np.linspace(-12, 10, 16))


def discs(
    centres: Array, normals: Array, *, spacing: float, opacity: float = 0.95
) -> GaussianCloud:
    """Flat Gaussians that form an opaque surface."""
    half = np.cross([1.0, 0, 0], normals)
    w = 1 + normals[:, :1]
    backwards = w[:, 0] < 1e-6
    quats = np.concatenate([w, half], axis=1)
    quats[backwards] = (0.0, 0, 0, 1)
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    n = len(centres)
    parts = (
        centres,
        quats,
        np.tile([1e-4, spacing, spacing], (n, 1)),
        np.full(n, opacity),
        np.zeros((n, 1, 3)),
    )
    return GaussianCloud(*(torch.from_numpy(part.astype(np.float32)) for part in parts))


def wall(normal: Sequence[float], offset: float, *, half: float, spacing: float) -> GaussianCloud:
    """The vertical plane ``normal . x = -offset``, facing the origin."""
    n = np.array([*normal, 0.0])
    along = np.array([-n[1], n[0], 0.0])
    across, up = np.meshgrid(np.arange(-half, half, spacing), np.arange(-6, 6, spacing))
    centres = -offset * n + across.reshape(-1, 1) * along + up.reshape(-1, 1) * [0, 0, 1.0]
    return discs(centres, np.tile(n, (len(centres), 1)), spacing=spacing)


ROOM = (((-1.0, 0.0), 16.0), ((1.0, 0.0), 16.0), ((0.0, -1.0), 12.0), ((0.0, 1.0), 12.0))


@pytest.fixture(scope="module")
def room() -> GaussianCloud:
    """Four walls around the origin."""
    walls = [wall(normal, offset, half=17.0, spacing=0.25) for normal, offset in ROOM]
    return GaussianCloud.concatenate(walls)


def room_ranges(origins: Array, directions: Array) -> Array:
    """Exact ranges in the room; NaN in its corners, where the Gaussians of two walls overlap."""
    distances = []
    for normal, offset in ROOM:
        n = np.array([*normal, 0.0])
        towards = directions @ n
        with np.errstate(divide="ignore"):
            distance = -(origins @ n + offset) / towards
        distances.append(np.where(towards < 0, distance, np.inf))
    nearest, next_one = np.sort(distances, axis=0)[:2]
    return np.where(next_one - nearest > 1.0, nearest, np.nan)


def driving(lidar: Lidar, *, speed: float, turn_deg: float) -> Array:
    """Poses [S, 4, 4] of a sensor that moves forward and turns."""
    seconds = lidar.beams.slots[0] * 1e-6
    positions = np.stack([speed * seconds, 0.1 * speed * seconds, 0 * seconds], axis=-1)
    return transform_from(positions, yaw_quaternion(np.radians(turn_deg) * seconds))


def true_ranges(lidar: Lidar, poses: Array) -> Array:
    """Exact ranges with the sensor pose at the time of each ray."""
    pose = poses[lidar.beams.slots[1]]
    directions = np.einsum("...ij,...j->...i", pose[..., :3, :3], lidar.beams.directions)
    return room_ranges(pose[..., :3, 3], directions)


def spinning(**changes: object) -> Lidar:
    given: dict[str, object] = {"min_range": 0.5, "max_range": 80.0, **changes}
    return Lidar("spinning", Beams.spinning(ROWS, columns=256), **given)  # type: ignore[arg-type]


@pytest.mark.parametrize("distance", [5.0, 20.0, 60.0])
def test_a_plane_is_measured_within_a_millimetre(distance: float) -> None:
    plane = wall((-1.0, 0.0), distance, half=6.0, spacing=0.25)
    lidar = spinning()
    echo = cast([Instance(plane)], lidar, np.eye(4))
    directions = lidar.beams.directions
    with np.errstate(divide="ignore"):
        truth = distance / directions[..., 0]
    side, up = (np.abs(truth * directions[..., k]) < 5.0 for k in (1, 2))
    inside = (directions[..., 0] > 0) & side & up
    assert inside.sum() >= 16
    assert echo.hit[inside].all()
    assert np.abs(echo.range - truth)[inside].max() <= 1e-3


def test_ego_motion_adds_no_error(room: GaussianCloud) -> None:
    lidar = spinning()
    still = cast([Instance(room)], lidar, np.eye(4))
    poses = driving(lidar, speed=15.0, turn_deg=30.0)
    moving = cast([Instance(room)], lidar, poses)
    at_rest = np.abs(still.range - true_ranges(lidar, np.broadcast_to(np.eye(4), poses.shape)))
    on_the_way = np.abs(moving.range - true_ranges(lidar, poses))
    assert np.isfinite(on_the_way).mean() > 0.9
    assert np.nanmax(at_rest) <= 1e-3
    assert np.nanmax(on_the_way) <= 1e-3
    # With one pose for all rays, ranges are off by more than 0.5 m.
    frozen = np.abs(moving.range - true_ranges(lidar, np.broadcast_to(np.eye(4), poses.shape)))
    assert np.nanmax(frozen) > 0.5


def test_the_azimuth_seam_adds_no_error(room: GaussianCloud) -> None:
    lidar = spinning()
    poses = driving(lidar, speed=15.0, turn_deg=30.0)
    echo = cast([Instance(room)], lidar, poses)
    error = np.abs(echo.range - true_ranges(lidar, poses))
    seam = np.abs(np.abs(lidar.beams.azimuth) - np.pi) < np.radians(6)
    assert seam.sum() > 100
    assert np.nanmax(error[seam]) <= max(np.nanmax(error[~seam]), 1e-4)
    # No Gaussian is hit twice: opacity accumulates as elsewhere.
    assert echo.hit.all()
    assert np.median(echo.opacity[seam]) == pytest.approx(np.median(echo.opacity[~seam]), abs=0.01)


def test_moving_objects_are_hit_at_the_time_of_each_ray() -> None:
    lidar = spinning()
    seconds = lidar.beams.slots[0] * 1e-6
    plane = wall((-1.0, 0.0), 0.0, half=4.0, spacing=0.2)
    poses = transform_from(
        np.stack([15 + 20 * seconds, 0 * seconds, 0 * seconds], -1), np.array([1.0, 0, 0, 0])
    )
    echo = cast(
        [Instance(plane, poses[128], instance_id=7)], lidar, np.eye(4), object_poses=[poses]
    )
    directions = lidar.beams.directions
    with np.errstate(divide="ignore"):
        truth = (15 + 20 * seconds)[lidar.beams.slots[1]] / directions[..., 0]
    inside = (directions[..., 0] > 0) & (np.abs(truth * directions[..., 1]) < 3)
    assert np.abs(echo.range - truth)[inside].max() <= 1e-3
    assert (echo.instance[inside] == 7).all()


def test_two_panes_give_the_first_and_the_last_return() -> None:
    def pane(distance: float, opacity: float) -> GaussianCloud:
        centre = np.array([[distance, 0.0, 0]])
        return discs(centre, np.array([[-1.0, 0, 0]]), spacing=20.0, opacity=opacity)

    cloud = GaussianCloud.concatenate([pane(10.0, 0.4), pane(20.0, 0.999)])
    lidar = spinning(returns=3)
    echo = cast([Instance(cloud)], lidar, np.eye(4))
    ahead = np.abs(lidar.beams.azimuth) < np.radians(10)
    slant = lidar.beams.directions[..., 0][ahead]
    first, last = echo.returns["first"], echo.returns["last"]
    assert np.allclose(first.range[ahead], 10 / slant, atol=1e-3)
    assert np.allclose(last.range[ahead], 20 / slant, atol=1e-3)
    assert np.allclose(first.power[ahead], 0.4, atol=0.02)
    # The light passes the first pane twice: 0.6^2 is left for the second.
    assert np.allclose(last.power[ahead], 0.36, atol=0.03)


def scattered(seed: int = 3) -> tuple[list[Instance], list[NDArray[np.float32]]]:
    """Random Gaussians: a background, an object and an object with covariances."""
    rng = np.random.default_rng(seed)

    def cloud(n: int, reach: float) -> GaussianCloud:
        quats = rng.normal(size=(n, 4))
        parts = (
            rng.uniform((-reach, -reach, -3), (reach, reach, 3), (n, 3)),
            quats / np.linalg.norm(quats, axis=1, keepdims=True),
            np.exp(rng.uniform(np.log(0.005), np.log(0.6), (n, 3))),
            rng.uniform(0, 1, n),
            np.zeros((n, 1, 3)),
        )
        return GaussianCloud(*(torch.from_numpy(part.astype(np.float32)) for part in parts))

    deformed = cloud(50, 2)
    shape = rng.normal(0, 0.15, (50, 3, 3))
    covars = torch.from_numpy((shape @ shape.transpose(0, 2, 1) + 1e-4 * np.eye(3)).astype("f4"))
    placed = transform_from([-9.0, 0.5, 0], yaw_quaternion(0.3))
    instances = [
        Instance(cloud(500, 20)),
        Instance(cloud(80, 2), placed, instance_id=3),
        Instance(deformed, transform_from([6.0, -5, 0], yaw_quaternion(1.0)), 4, covars=covars),
    ]
    return instances, [rng.uniform(0, 1, (len(i.cloud), 2)).astype("f4") for i in instances]


def table() -> Beams:
    rng = np.random.default_rng(4)
    return Beams(
        rng.uniform(-0.6, 0.6, 500), rng.uniform(-0.3, 0.3, 500), rng.integers(-9, 9, 500) * 5000.0
    )


@pytest.mark.parametrize(
    "beams",
    [
        Beams.spinning(ROWS[::2], columns=48),
        Beams.spinning(
            ROWS[::2],
            columns=48,
            clockwise=False,
            azimuth_offset=np.radians(np.tile([8.0, 3, -3, -8], 2)),
        ),
        table(),
    ],
    ids=["spinning", "offsets", "table"],
)
def test_the_kernel_matches_the_reference(beams: Beams) -> None:
    lidar = Lidar("any", beams, min_range=1.0, max_range=40.0, divergence=(0.01, 0.005), returns=3)
    instances, attributes = scattered()
    poses = driving(lidar, speed=15.0, turn_deg=30.0)
    seconds = beams.slots[0] * 1e-6
    first = instances[1].T_world_object
    assert isinstance(first, np.ndarray)
    moved = first @ transform_from(
        np.stack([9 * seconds, 0 * seconds, 0 * seconds], -1), [1.0, 0, 0, 0]
    )
    kernel, twin = (
        cast(
            instances,
            lidar,
            poses,
            object_poses=[None, moved, None],
            attributes=attributes,
            backend=backend,
        )
        for backend in ("cpu", "reference")
    )
    # The beam width is evaluated at the time of the centre, so contributions near the limit of
    # 1/255 may count in only one of the two.
    difference = np.abs(kernel.opacity - twin.opacity)
    assert difference.max() < 4 / 255
    assert np.quantile(difference, 0.98) < 2e-3
    same = kernel.member == twin.member
    assert same.mean() > 0.995
    assert np.abs(kernel.range - twin.range)[same].max() < 1e-3
    assert np.array_equal(kernel.instance[same], twin.instance[same])
    for name in ("expected", "intensity", "drop"):
        difference = np.abs(getattr(kernel, name) - getattr(twin, name)) * twin.opacity
        assert np.quantile(difference, 0.99) < 0.02
    for name, found in kernel.returns.items():
        difference = np.abs(found.range - twin.returns[name].range)
        assert (difference > 1e-2).mean() < 0.01


def digest(echo: Echo) -> str:
    images = (echo.range, echo.expected, echo.opacity, echo.intensity, echo.instance, echo.member)
    return hashlib.sha256(b"".join(image.tobytes() for image in images)).hexdigest()


def test_results_do_not_depend_on_the_number_of_threads() -> None:
    instances, attributes = scattered()
    lidar = spinning()
    poses = driving(lidar, speed=15.0, turn_deg=30.0)
    digests = set()
    threads = numba.get_num_threads()
    try:
        for count in range(1, threads + 1):
            numba.set_num_threads(count)
            digests.add(digest(cast(instances, lidar, poses, attributes=attributes)))
    finally:
        numba.set_num_threads(threads)
    assert len(digests) == 1


def test_an_empty_world_gives_no_return() -> None:
    echo = cast([], spinning(), np.eye(4))
    assert not echo.hit.any()
    assert (echo.member == -1).all()


def test_poses_of_another_length_are_refused() -> None:
    with pytest.raises(RenderError, match=r"\[256, 4, 4\].*not \[7, 4, 4\]"):
        cast([], spinning(), np.broadcast_to(np.eye(4), (7, 4, 4)))


def test_non_rigid_poses_are_refused() -> None:
    with pytest.raises(RenderError, match="not rigid transforms"):
        cast([], spinning(), np.full((4, 4), np.nan))


def test_attributes_of_another_cloud_are_refused(room: GaussianCloud) -> None:
    with pytest.raises(RenderError, match=r"attributes\[0\] must be"):
        cast([Instance(room)], spinning(), np.eye(4), attributes=[np.zeros((3, 2), np.float32)])


def test_an_unknown_backend_is_refused() -> None:
    with pytest.raises(RenderError, match="unknown cast backend 'gpu'"):
        cast([], spinning(), np.eye(4), backend="gpu")
