"""Labels with known answers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from real2sim_proto.conventions import GROUND, SEMANTIC_CLASSES
from real2sim_server.datasets.clips import flow_png, read_flow
from real2sim_server.datasets.drive import ScenarioDrive
from real2sim_server.datasets.labels import (
    CameraImages,
    ObjectBox,
    boxes_at,
    draw_moment,
    ego_future,
    flow_between,
    futures_at,
    projected_box,
    views_of,
)
from real2sim_server.datasets.labels.boxes import truncation
from real2sim_server.datasets.labels.images import body_of, on_surface
from real2sim_server.datasets.labels.pixels import surface_mask, tell_apart
from real2sim_server.edit import ScenarioState
from real2sim_server.render.lens import back_projected
from real2sim_server.scene import Camera, LidarSurfaces, Reflector, Trajectory
from real2sim_server.scene.cloud import UNSEEN

CAMERA = Camera("c", 96, 64, np.array([[60.0, 0, 48], [0, 60, 32], [0, 0, 1]]), np.eye(4))


def pose(x: float, y: float, z: float) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, 3] = x, y, z
    return matrix


def plane(depth: float, camera_x: float = 0.0, instance: int = 0) -> CameraImages:
    """A wall across the whole image."""
    shape = (CAMERA.height, CAMERA.width)
    return CameraImages(
        CAMERA,
        pose(camera_x, 0, 0),
        np.zeros((*shape, 3), np.uint8),
        np.full(shape, depth, np.float32),
        np.full(shape, instance, np.uint16),
        np.zeros(shape, np.uint8),
    )


def box(x: float) -> ObjectBox:
    return ObjectBox("car_0", "car", 1, (4, 2, 2), pose(x, 0, 10), np.zeros(3))


def test_the_box_of_a_cube_is_that_of_its_near_face():
    left, top, right, bottom = projected_box(pose(0, 0, 10), (2, 2, 2), CAMERA, np.eye(4))
    assert (left, right) == pytest.approx((48 - 60 / 9, 48 + 60 / 9))
    assert (top, bottom) == pytest.approx((32 - 60 / 9, 32 + 60 / 9))


def test_a_box_reaching_behind_the_camera_is_clipped_at_the_near_plane():
    left, _, right, _ = projected_box(pose(0, 0, 0), (2, 2, 10), CAMERA, np.eye(4))
    assert (left, right) == pytest.approx((48 - 600, 48 + 600))
    assert projected_box(pose(0, 0, -10), (2, 2, 2), CAMERA, np.eye(4)) is None


def test_a_box_in_the_image_is_not_truncated():
    assert truncation(pose(0, 0, 10), (2, 2, 2), CAMERA, np.eye(4)) == 0


def test_half_of_a_box_across_the_image_border_is_truncated():
    ahead = np.array([-0.8, 0, 1]) / np.hypot(0.8, 1)  # through the middle of the left border
    facing = np.eye(4)
    facing[:3, :3] = np.column_stack([np.cross([0, 1, 0], ahead), [0, 1, 0], ahead])
    facing[:3, 3] = 12 * ahead
    assert truncation(facing, (2, 2, 4), CAMERA, np.eye(4)) == pytest.approx(0.5)


def test_the_part_of_a_box_behind_the_camera_is_truncated():
    # Its side at x = 2 is in the image from z = 2.5 on and goes from -5 to 5.
    assert truncation(pose(3, 0, 0), (2, 1, 10), CAMERA, np.eye(4)) == pytest.approx(0.75)
    assert truncation(pose(0, 0, -10), (2, 2, 2), CAMERA, np.eye(4)) == 1
    assert truncation(pose(0, 0, 1), (2, 2, 4), CAMERA, np.eye(4)) == 1  # around the camera


def sampled_truncation(T_object: np.ndarray, size: np.ndarray, camera: Camera) -> float:
    """Share outside the image of points spread evenly over the faces towards the camera at 0."""
    outside = total = 0.0
    spread = (np.stack(np.meshgrid(*[np.arange(60)] * 2), -1).reshape(-1, 2) + 0.5) / 60 - 0.5
    for axis in range(3):
        others = [k for k in range(3) if k != axis]
        for end in (-0.5, 0.5):
            points = np.full((len(spread), 3), end)
            points[:, others] = spread
            world = points * size @ T_object[:3, :3].T + T_object[:3, 3]
            if np.sign(end) * (T_object[:3, axis] @ world[0]) < 0:
                u, v, w = (world @ camera.K.T).T
                with np.errstate(divide="ignore"):
                    u, v = u / w, v / w
                seen = (w > 0) & (u > 0) & (u < camera.width) & (v > 0) & (v < camera.height)
                area = size[others[0]] * size[others[1]]
                outside, total = outside + area * (~seen).mean(), total + area
    return outside / total


def test_truncation_is_the_share_of_the_surface_outside_the_image():
    rng, found = np.random.default_rng(0), []
    for turn in Rotation.random(200, random_state=0):
        T_object = pose(*rng.uniform((-6, -4, -3), (6, 4, 12)))
        T_object[:3, :3], size = turn.as_matrix(), rng.uniform(0.5, 6, 3)
        if (np.abs(turn.inv().apply(T_object[:3, 3])) < size / 2).all():
            continue  # around the camera
        found.append(truncation(T_object, size, CAMERA, np.eye(4)))
        assert found[-1] == pytest.approx(sampled_truncation(T_object, size, CAMERA), abs=0.02)
    assert np.histogram(found, [0, 0.01, 0.3, 0.7, 0.99, 1.01])[0].min() >= 5


def test_flow_of_a_wall_follows_the_camera():
    flow, valid, occluded = flow_between(plane(10.0), plane(10.0, camera_x=1.0), [], [])
    np.testing.assert_allclose(flow[..., 0], -6.0, atol=1e-4)
    np.testing.assert_allclose(flow[..., 1], 0.0, atol=1e-4)
    assert valid.all()
    assert occluded[:, :5].all()
    assert not occluded[:, 6:].any()


def test_flow_of_an_object_follows_its_pose():
    here, there = plane(10.0, instance=1), plane(10.0, instance=1)
    flow, valid, _ = flow_between(here, there, [box(0.0)], [box(0.5)])
    np.testing.assert_allclose(flow[..., 0], 3.0, atol=1e-4)
    gone = flow_between(here, there, [box(0.0)], [])[1]
    assert valid.all()
    assert not gone.any()


def test_flow_is_marked_occluded_when_something_comes_in_front():
    _, valid, occluded = flow_between(plane(10.0), plane(5.0), [], [])
    assert valid.all()
    assert occluded.all()


def test_flow_is_stored_to_a_128th_of_a_pixel():
    flow = np.array([[[1.25, -3.5], [0.0, 0.01]]], np.float32)
    import cv2

    data = np.frombuffer(flow_png(flow, np.array([[True, False]])), np.uint8)
    stored, valid = read_flow(cv2.imdecode(data, cv2.IMREAD_UNCHANGED))
    np.testing.assert_allclose(stored[0, 0], [1.25, -3.5])
    assert valid.tolist() == [[True, False]]


def test_an_object_behind_another_is_less_visible(tiny_scene, tiny_drive):
    hidden = tiny_scene.objects["car_red"]
    front = tiny_scene.objects["car_blue"].trajectory.transform(0)[:3, 3]
    behind = Trajectory(np.array([0]), front[None] + [[6.0, 1.6, 0]], np.array([[1.0, 0, 0, 0]]))
    state = tiny_drive.state.with_object(
        replace(tiny_drive.state.objects["car_red"], trajectory=behind)
    )
    moment = replace(tiny_drive, state=state).at(0)
    (images,) = draw_moment(tiny_scene, moment, [tiny_scene.rig["front"]])
    view = views_of(images, boxes_at(moment.placed), moment.instances)
    visibility = {v.object_id: v.visibility for v in view.objects}
    assert visibility["car_blue"] > 0.9
    assert 0.0 < visibility[hidden.object_id] < 0.7


@pytest.mark.parametrize(
    ("place", "own"),
    [
        ((1.9, 0.0, -0.85), False),  # below the bumper
        ((0.0, 0.95, -0.85), False),  # below the sill
        ((1.2, 0.95, -0.85), True),  # a wheel
        ((1.9, 0.0, -0.7), True),
        ((1.9, 1.2, 0.0), False),
    ],
)
def test_a_vehicles_shadow_shows_between_its_wheels(place, own):
    points = np.add([place], (0, 0, 10))
    assert on_surface(points, pose(0, 0, 10), box(0.0)).tolist() == [own]


@pytest.mark.parametrize(
    ("eye", "place", "own"),
    [
        ((0, 9, 0.7), (0.0, 0.3, -1.0), False),  # under the sill, on the road
        ((0, 9, 0.7), (0.0, 0.3, -0.78), False),  # the road, estimated too near
        ((0, 9, 0.7), (0.0, 0.85, -0.65), True),  # the sill
        ((0, 9, 0.7), (0.0, 0.5, -0.7), True),  # the sill, estimated too far
        ((1.2, 9, 0.7), (1.2, 0.9, -0.98), True),  # a tyre where it touches the road
        ((1.2, 9, 0.7), (1.2, 0.2, -1.0), True),  # a tyre, estimated too far
        ((1.2, 9, 0.7), (1.2, 1.4, -1.0), False),  # the road in front of the tyre
        ((12, 0, 0.7), (1.5, 0.0, -1.0), False),  # under the bumper
        ((12, 0.8, 0.7), (1.5, 0.8, -0.95), True),  # a front tyre below the bumper
        ((0, 9, 0.7), (0.0, 1.12, 0.0), True),  # a side that is a little too near
        ((9, 9, 0.7), (0.0, 1.3, 0.0), False),  # a wall beside it
        ((30, 1.3, 0.7), (2.1, 1.12, 0.0), False),  # what is visible past the box
    ],
)
def test_the_ray_entry_point_tells_a_vehicle_from_its_shadow(eye, place, own):
    ahead = np.subtract(place, eye, dtype=np.float64)
    rays = np.column_stack([np.zeros((3, 2)), ahead, np.add(eye, (0, 0, 10))])
    mask = np.empty((1, 1), np.bool_)
    surface_mask(np.ones((1, 1), np.float32), 0, 0, rays, body_of(box(0.0), pose(0, 0, 10)), mask)
    assert mask[0, 0] == own


def test_ground_depth_follows_the_ground_heights(tiny_scene, tiny_drive):
    moment = tiny_drive.at(0)
    (images,) = draw_moment(tiny_scene, moment, [tiny_scene.rig["front"]])
    points = back_projected(images.depth, images.camera.K, images.T_world_camera)
    shown = points[images.semantic == GROUND]
    assert len(shown) > 100
    np.testing.assert_allclose(shown[:, 2], tiny_scene.ground.height_at(shown[:, :2]), atol=5e-3)


def drawn_with_lidar(scene, *, uncertainty: float, backend: str = "cpu") -> list[CameraImages]:
    """The front camera of a scene without and with LiDAR surfaces: those of its blue car are 0.3 m
    farther and half as wide.
    """
    parts = []
    car = scene.object("car_blue").cloud
    car = car.select(car.means[:, 1].abs() < 0.5)
    for cloud in (scene.background, replace(car, means=car.means + torch.tensor([0.3, 0, 0]))):
        known = torch.full((len(cloud),), uncertainty)
        parts.append(Reflector(replace(cloud, uncertainties=known), torch.zeros(len(cloud), 2)))
    surfaces = LidarSurfaces(parts[0], {"car_blue": parts[1]})
    drawn = []
    for each in (scene, replace(scene, lidar=surfaces)):
        moment = ScenarioDrive(each, ScenarioState.of(each)).at(0)
        drawn += draw_moment(each, moment, [each.rig["front"]], backend=backend)
    return drawn


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_depth_is_that_of_lidar_surfaces_where_they_show_the_same_object(tiny_scene, backend):
    image, lidar = drawn_with_lidar(tiny_scene, uncertainty=0.0, backend=backend)
    np.testing.assert_array_equal(image.rgb, lidar.rgb)
    on_car = image.instance == tiny_scene.instance_id("car_blue")
    columns = np.flatnonzero(on_car.any(axis=0))
    middle = on_car.copy()
    middle[:, np.abs(np.arange(on_car.shape[1]) - columns.mean()) > len(columns) / 5] = False
    deeper = lidar.depth - image.depth
    assert middle.sum() > 20
    assert np.median(deeper[middle]) == pytest.approx(0.3, abs=0.02)
    # The sides of the car, in front of which a LiDAR would see the background.
    aside = on_car.copy()
    aside[:, columns[2] : columns[-2]] = False
    aside &= lidar.instance == image.instance
    assert aside.sum() > 10
    np.testing.assert_allclose(deeper[aside], 0, atol=1e-4)


def test_lidar_surfaces_that_no_beam_measured_do_not_count(tiny_scene):
    image, lidar = drawn_with_lidar(tiny_scene, uncertainty=UNSEEN)
    np.testing.assert_array_equal(image.depth, lidar.depth)
    np.testing.assert_array_equal(image.instance, lidar.instance)


def test_objects_without_lidar_surfaces_keep_their_labels(tiny_scene):
    car = tiny_scene.object("car_blue")
    known = replace(car.cloud, uncertainties=torch.zeros(len(car.cloud)))
    objects = {**tiny_scene.objects, "car_blue": replace(car, cloud=known)}
    background = Reflector(tiny_scene.background, torch.zeros(len(tiny_scene.background), 2))
    drawn = []
    for lidar in (None, LidarSurfaces(background)):
        scene = replace(tiny_scene, objects=objects, lidar=lidar)
        moment = ScenarioDrive(scene, ScenarioState.of(scene)).at(0)
        drawn += draw_moment(scene, moment, [scene.rig["front"]])
    image, lidar = drawn
    np.testing.assert_array_equal(image.instance, lidar.instance)


@pytest.mark.parametrize(
    ("lidar", "own"),
    [
        (None, False),  # the body has only wheels there
        ((1.0, 1), True),  # a side guard
        ((1.0, 0), False),  # the road
        ((1.3, 0), False),  # the body again, since this is neither
    ],
)
def test_lidar_surfaces_tell_a_side_guard_from_a_shadow(lidar, own):
    place, eye = np.array([0, 0.95, 9.12]), np.array([0, 9, 10.7])
    rays = np.column_stack([np.zeros((3, 2)), place - eye, eye])
    depth, instance = np.ones((1, 1), np.float32), np.ones((1, 1), np.uint16)
    classes, slots = np.zeros(65_536, np.uint8), np.full(65_536, -1, np.int16)
    slots[1], classes[1] = 0, SEMANTIC_CLASSES["car"]
    seen = (0, 0) if lidar is None else (1, 1)
    shown, number = lidar or (0, 0)
    images = np.full(seen, shown, np.float32), np.full(seen, number, np.uint16)
    ground = np.full((2, 2), 9.0), np.array([-50.0, -50.0, 100.0])
    semantic, body = np.zeros((1, 1), np.uint8), body_of(box(0.0), pose(0, 0, 10))[None]
    tell_apart(depth, instance, semantic, rays, slots, body, classes, 0, images, *ground)
    assert (instance[0, 0] == 1) == own


def test_futures_extend_to_the_end_of_the_drive(tiny_drive):
    rows = futures_at(tiny_drive, 1_000_000, ["car_blue"])["car_blue"]
    assert [row[0] for row in rows] == [0.5, 1.0]
    assert rows[1][1] == pytest.approx(28.0)
    assert [row[1] for row in ego_future(tiny_drive, 1_000_000)] == pytest.approx([2.5, 5.0])
