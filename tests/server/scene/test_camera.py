import numpy as np
import pytest

from real2sim_server.geometry import apply_transform, transform_from, yaw_quaternion
from real2sim_server.scene import Camera, CameraRig, SceneError
from real2sim_server.scene.camera import T_VEHICLE_OPTICAL

K = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])


def front(name: str = "front") -> Camera:
    pose = T_VEHICLE_OPTICAL.copy()
    pose[:3, 3] = [1.0, 0, 1.5]
    return Camera(name, 640, 480, K, pose)


def project(camera: Camera, T_world_vehicle: np.ndarray, point: list[float]) -> np.ndarray:
    x, y, z = apply_transform(camera.viewmat(T_world_vehicle), np.array([point]))[0]
    return np.array([*(camera.K @ [x / z, y / z, 1])[:2], z])


def test_a_point_ahead_projects_to_the_image_centre():
    np.testing.assert_allclose(project(front(), np.eye(4), [11, 0, 1.5]), [320, 240, 10])


def test_left_and_up_in_the_world_are_left_and_up_in_the_image():
    column, row, _ = project(front(), np.eye(4), [11, 1, 2.5])
    np.testing.assert_allclose([column, row], [270, 190])


def test_the_view_follows_the_vehicle():
    T_world_vehicle = transform_from([5.0, 5, 0], yaw_quaternion(np.pi / 2))
    np.testing.assert_allclose(project(front(), T_world_vehicle, [5, 16, 1.5]), [320, 240, 10])


@pytest.mark.parametrize("width", [320, 1280, 333])
def test_resizing_keeps_the_field_of_view(width):
    small = front().resized(width)
    assert small.width == width
    assert small.height == round(480 * width / 640)
    np.testing.assert_allclose(small.K[0] / small.width, K[0] / 640)
    np.testing.assert_allclose(small.K[1] / small.height, K[1] / 480)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"width": 0}, "not positive"),
        ({"height": -3}, "not positive"),
        ({"K": np.eye(4)}, "3x3"),
        ({"K": np.full((3, 3), np.nan)}, "3x3"),
        ({"K": np.diag([-1.0, 1, 1])}, "focal lengths"),
        ({"T_vehicle_camera": np.eye(3)}, "rigid"),
        ({"T_vehicle_camera": np.diag([1.0, 1, -1, 1])}, "rigid"),
        ({"T_vehicle_camera": np.eye(4) * 2}, "rigid"),
        ({"T_vehicle_camera": np.eye(4) + np.diag([0.0, 0, 0, 1])}, "rigid"),
    ],
)
def test_bad_calibration_is_refused_by_name(change, reason):
    given = {"name": "cam", "width": 64, "height": 48, "K": K, "T_vehicle_camera": np.eye(4)}
    with pytest.raises(SceneError, match=rf"camera 'cam'.*{reason}"):
        Camera(**(given | change))


def test_a_rig_finds_cameras_by_name_and_keeps_their_order():
    rig = CameraRig((front("b"), front("a")))
    assert rig.names == ("b", "a")
    assert rig["a"].name == "a"
    assert [c.name for c in rig] == ["b", "a"]
    assert len(rig) == 2


def test_an_unknown_camera_is_refused_with_the_known_ones():
    with pytest.raises(SceneError, match=r"unknown camera 'x'.*'front'"):
        CameraRig((front(),))["x"]


def test_duplicate_camera_names_are_refused():
    with pytest.raises(SceneError, match="unique"):
        CameraRig((front(), front()))
