"""People and cyclists on the synthetic street, and the truth about them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from real2sim_server.geometry import apply_transform, invert_transform
from real2sim_server.logs.driving_log import DrivingLog
from real2sim_server.synthetic import SyntheticConfig, SyntheticLog, generate_log
from real2sim_server.synthetic.people_casting import part_names
from real2sim_server.synthetic.traffic import plan_drive
from real2sim_server.synthetic.vehicles import SHAPES

CONFIG = SyntheticConfig(
    seed=3, frames=4, width=240, height=160, lidar_columns=720, lidar_noise=0.0,
    moving_cars=2, parked_cars=4, pedestrians=6, cyclists=2,
)  # fmt: skip


@pytest.fixture(scope="module")
def log() -> SyntheticLog:
    return generate_log(CONFIG)


def _people(log: SyntheticLog) -> list[int]:
    return [i for i, t in enumerate(log.tracks) if t.category in {"pedestrian", "cyclist"}]


def _before(log: SyntheticLog, track: int, t_us: int, *, away: float = 4.0):
    """A camera that looks at somebody from in front, and its intrinsics."""
    T_world_object = log.tracks[track].trajectory.transform(t_us)
    pose = np.eye(4)
    pose[:3, :3] = [[0, 0, -1], [1, 0, 0], [0, -1, 0]]
    pose[0, 3] = away
    k = np.array([[150.0, 0, 80], [0, 150, 80], [0, 0, 1]])
    return T_world_object @ pose, k


def test_as_many_as_asked_are_there(log):
    categories = [t.category for t in log.tracks]
    assert categories.count("pedestrian") == CONFIG.pedestrians
    assert categories.count("cyclist") == CONFIG.cyclists
    assert len({t.object_id for t in log.tracks}) == len(log.tracks)


def test_people_leave_the_street_and_its_vehicles_as_they_are(log):
    alone = generate_log(replace(CONFIG, pedestrians=0, cyclists=0))
    for one, other in zip(alone.tracks, log.tracks, strict=False):
        assert one.object_id == other.object_id
        np.testing.assert_array_equal(one.trajectory.positions, other.trajectory.positions)
    lens, t_us = log.rig["front"], 0
    pose = lens.pose(log.ego.transform(t_us))
    size = lens.width, lens.height
    _, depth, instance = log.render(pose, lens.K, *size, t_us)
    _, bare_depth, bare = alone.render(pose, lens.K, *size, t_us)
    nobody = instance <= len(alone.tracks)
    np.testing.assert_array_equal(instance[nobody], bare[nobody])
    np.testing.assert_array_equal(depth[nobody], bare_depth[nobody])
    assert (~nobody).sum() > 20


def test_they_are_seen_and_their_boxes_hold_them(log):
    for index in _people(log):
        track = log.tracks[index]
        for t_us in log.frame_times_us[[0, 2]]:
            pose, k = _before(log, index, int(t_us))
            _, depth, instance = log.render(pose, k, 160, 160, int(t_us))
            own = instance == index + 1
            assert own.sum() > 400, track.object_id
            rays = np.stack(np.meshgrid(np.arange(160) + 0.5, np.arange(160) + 0.5), axis=-1)
            flat = np.concatenate([(rays - 80) / 150, np.ones((160, 160, 1))], axis=-1)
            points = apply_transform(pose, (flat * depth[..., None])[own])
            local = apply_transform(invert_transform(track.trajectory.transform(int(t_us))), points)
            assert (np.abs(local) <= np.array(track.size) / 2 + 0.002).all()


def test_people_are_as_large_as_people(log):
    for index in _people(log):
        length, width, height = log.tracks[index].size
        assert 0.9 < height < 2.2
        assert 0.3 < width < 0.9
        assert 0.25 < length < 2.15


def test_parts_cover_a_person_from_head_to_foot(log):
    index, t_us = _people(log)[0], int(log.frame_times_us[1])
    pose, k = _before(log, index, t_us)
    _, _, instance = log.render(pose, k, 160, 160, t_us)
    parts = log.render_parts(pose, k, 160, 160, t_us)
    first = min(_people(log))
    np.testing.assert_array_equal(parts > 0, instance > first)
    names = part_names(log.source.drive.people[0])
    rows = {
        name: np.nonzero(((parts - 1) == names.index(name)) & (instance == index + 1))[0].mean()
        for name in ("head", "torso", "calf_l", "foot_l")
    }
    assert rows["head"] < rows["torso"] < rows["calf_l"] < rows["foot_l"]


def test_keypoints_lie_in_the_silhouette(log):
    """Joints are inside the body, so from in front they project into its picture."""
    t_us = int(log.frame_times_us[1])
    truth = log.people(t_us)
    assert truth.tracks.tolist() == _people(log)
    for number, index in enumerate(truth.tracks):
        pose, k = _before(log, int(index), t_us)
        _, _, instance = log.render(pose, k, 160, 160, t_us)
        mask = instance == index + 1
        grown = np.zeros_like(mask)
        for dx in (-2, -1, 0, 1, 2):
            for dy in (-2, -1, 0, 1, 2):
                grown |= np.roll(mask, (dy, dx), axis=(0, 1))
        seen = apply_transform(invert_transform(pose), truth.keypoints[number])
        pixel = (seen[:, :2] / seen[:, 2:] * 150 + 80).astype(int)
        assert grown[pixel[:, 1], pixel[:, 0]].mean() > 0.9


def test_lidar_points_lie_on_their_surface(log):
    frame = 2
    sweep, t_us = log.lidar(frame), int(log.frame_times_us[frame])
    found = 0
    for index in _people(log):
        mesh = log.source.people.meshes[index - min(_people(log))]
        track = log.tracks[index]
        to_object = invert_transform(track.trajectory.transform(t_us)) @ log.ego.transform(t_us)
        velocity = log.ego.transform(t_us)[:3, :3].T @ track.trajectory.velocity(t_us)
        shifted = sweep.points - velocity * (sweep.offset_us * 1e-6)[:, None]
        local = apply_transform(to_object, shifted.astype(np.float64))
        own = (np.abs(local) < np.array(track.size) / 2).all(axis=1)
        own &= local[:, 2] > 0.2 - track.size[2] / 2
        for point, offset in zip(local[own][::3], sweep.offset_us[own][::3], strict=True):
            vertices = mesh.person.vertices(np.array([(t_us + int(offset)) * 1e-6]))[0]
            assert _away(vertices[mesh.triangles], point) < 0.035
            found += 1
    assert found > 20


def _away(corners, point) -> float:
    """Distance from a point to the nearest of triangles [T, 3, 3], or a little more."""
    share = [(i / 6, j / 6) for i in range(7) for j in range(7 - i)]
    grid = np.array([(1 - a - b, a, b) for a, b in share])
    near = corners[np.linalg.norm(corners.mean(axis=1) - point, axis=1) < 0.5]
    return float(np.linalg.norm(np.einsum("gc,tcx->tgx", grid, near) - point, axis=2).min())


def test_flow_of_the_street_is_that_of_its_depth(log):
    lens, times = log.rig["front"], (int(log.frame_times_us[0]), int(log.frame_times_us[1]))
    here, there = (lens.pose(log.ego.transform(t)) for t in times)
    size = lens.width, lens.height
    _, depth, instance = log.render(here, lens.K, *size, times[0])
    flow = log.flow(here, there, lens.K, *size, times)
    v, u = np.mgrid[: lens.height, : lens.width] + 0.5
    rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(lens.K).T
    points = apply_transform(
        invert_transform(there) @ here, (rays * depth[..., None]).reshape(-1, 3)
    )
    pixels = points @ lens.K.T
    wanted = (pixels[:, :2] / pixels[:, 2:]).reshape(*depth.shape, 2) - np.stack([u, v], axis=-1)
    static = (instance == 0) & (depth > 0)
    np.testing.assert_allclose(flow[static], wanted[static], atol=0.02)
    assert np.isnan(flow[depth == 0]).all()


@pytest.mark.slow
def test_flow_of_people_leads_to_the_same_people(log):
    times = int(log.frame_times_us[1]), int(log.frame_times_us[2])
    for index in _people(log):
        pose, k = _before(log, index, times[0])
        _, _, instance = log.render(pose, k, 160, 160, times[0])
        _, _, then = log.render(pose, k, 160, 160, times[1])
        flow = log.flow(pose, pose, k, 160, 160, times)
        own = np.argwhere(instance == index + 1)
        end = np.floor(own + 0.5 + flow[own[:, 0], own[:, 1], ::-1]).astype(int)
        inside = ((end >= 0) & (end < 160)).all(axis=1)
        # Somebody else may have stepped in between.
        assert (then[tuple(end[inside].T)] > min(_people(log))).mean() > 0.85


def test_pictures_do_not_depend_on_what_was_cast_before(log):
    first = log.image("front_right", 1)
    log.lidar(3)
    log.image("front", 2)
    np.testing.assert_array_equal(first, log.image("front_right", 1))
    np.testing.assert_array_equal(first, generate_log(CONFIG).image("front_right", 1))


def test_boxes_of_the_hierarchy_hold_their_triangles(log):
    with log.source.world_at(150_000) as world:
        for mesh in log.source.people.meshes:
            vertices = mesh.person.vertices(np.array([0.15]))[0][mesh.triangles]
            root = world.bounds[mesh.nodes[0]]
            np.testing.assert_allclose(root[:3], vertices.min(axis=(0, 1)))
            np.testing.assert_allclose(root[3:], vertices.max(axis=(0, 1)))


@pytest.mark.parametrize("seed", range(4))
def test_nobody_is_run_over(seed):
    drive = plan_drive(replace(CONFIG, seed=seed, frames=40, moving_cars=4, parked_cars=14))
    others = [(v.trajectory, *SHAPES[v.shape].size[:2]) for v in drive.vehicles]
    for t_us in drive.frame_times_us[::4]:
        ego = drive.ego.transform(int(t_us)).copy()
        ego[:2, 3] += 1.4 * ego[:2, 0]
        boxes = [(ego, *DrivingLog.ego_size[:2])]
        boxes += [(path.transform(int(t_us)), *size) for path, *size in others]
        for person in drive.people:
            at = person.trajectory.transform(int(t_us))[:2, 3]
            for pose, length, width in boxes:
                along, across = pose[:2, :2].T @ (at - pose[:2, 3])
                assert abs(along) > length / 2 + 0.2 or abs(across) > width / 2 + 0.2


def test_somebody_cannot_be_placed_as_a_vehicle(log):
    camera = log.rig["front"]
    with pytest.raises(ValueError, match="only vehicles can be placed"):
        log.render_placed(np.eye(4), camera.K, (8, 8), [_people(log)[0]], [np.eye(4)])


def test_fewer_than_nobody_is_refused():
    with pytest.raises(ValueError, match="pedestrians must be at least 0"):
        replace(CONFIG, pedestrians=-1)
