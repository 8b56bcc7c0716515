import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from real2sim_server.scene import (
    BrownConrady,
    Camera,
    CameraMotion,
    Fisheye,
    FTheta,
    Omnidirectional,
    SceneError,
    Shutter,
)
from real2sim_server.scene.camera import Optics
from real2sim_server.scene.lens import lens_from, lens_values

K = np.array([[900.0, 0, 641.5], [0, 880, 359.25], [0, 0, 1]])
BROWN = BrownConrady(
    (0.11, -0.09, 0.01, 0.12, -0.02, 0.004), (0.001, -0.0007), (0.0005, -0.0003, 0.0002, 0.0001)
)
FISHEYE = Fisheye((0.02, -0.01, 0.003, -0.0005))
OMNI = Omnidirectional(1.3, (-0.1, 0.02), (0.001, -0.002))
F_THETA = FTheta((0, 1, 0.01, -0.02, 0.003, -0.0004), max_angle=1.9)
BACKWARD = FTheta((0, 1, 0.01, 0.02, 0.003), "radius", (1.01, 0.002, -0.003), 1.7)
LENSES = [BROWN, FISHEYE, OMNI, replace(OMNI, xi=0.8), F_THETA, BACKWARD]


GLOBAL = Shutter()


def camera(lens=None, shutter=GLOBAL):
    return Camera("front", 1280, 720, K, np.eye(4), lens, shutter)


def project_moving(seen_by, motion, points, velocities=0.0):
    """Image positions, validity and times of points under a rolling shutter, by fixed-point
    iteration: the row of a point gives its time, and the time gives its position."""
    shutter, size = seen_by.shutter, (seen_by.width, seen_by.height)
    per_frame = np.broadcast_to(velocities, points.shape) * (shutter.readout_us * 1e-6)
    times = np.zeros(len(points))
    for _ in range(11 if shutter.rolls else 1):
        turns, places = motion.at(times)
        seen = points + per_frame * (times - 0.5)[:, None]
        pixels, valid = seen_by.project(np.einsum("nji,nj->ni", turns, seen - places))
        if shutter.rolls:
            times = shutter.times_at(pixels, *size)
    return pixels, valid, times


def directions(count=10_000):
    return np.random.default_rng(0).normal(size=(count, 3)) * [1, 0.6, 0.6] + [0, 0, 0.5]


def opencv(lens, points):
    still = np.zeros(3), np.zeros(3)
    if isinstance(lens, Fisheye):
        return cv2.fisheye.projectPoints(points[:, None], *still, K, np.array(lens.k))[0]
    if isinstance(lens, Omnidirectional):
        distortion = np.array([[*lens.k, *lens.p]])
        return cv2.omnidir.projectPoints(points[:, None], *still, K, lens.xi, distortion)[0]
    k = lens.radial
    distortion = np.array([*k[:2], *lens.tangential, *k[2:], *lens.thin_prism])
    return cv2.projectPoints(points, *still, K, distortion)[0]


@pytest.mark.parametrize("lens", LENSES[:4], ids=lambda lens: lens.model)
def test_projection_matches_opencv(lens):
    points = directions()
    if isinstance(lens, Fisheye):  # OpenCV takes no points behind the camera.
        points = points[points[:, 2] > 0.01]
    pixels, valid = camera(lens).project(points)
    on_image = valid & ((pixels >= 0) & (pixels <= [1280, 720])).all(1)
    assert on_image.sum() > 1000
    np.testing.assert_allclose(
        pixels[on_image], opencv(lens, points).reshape(-1, 2)[on_image], atol=0.01, rtol=0
    )


@pytest.mark.parametrize("lens", [None, *LENSES])
def test_unproject_inverts_project(lens):
    pixels = np.random.default_rng(1).uniform([0, 0], [1280, 720], (10_000, 2))
    rays, valid = camera(lens).unproject(pixels)
    again, seen = camera(lens).project(rays[valid] * 7)
    assert valid.sum() > 5000
    assert seen.all()
    np.testing.assert_allclose(again, pixels[valid], atol=1e-6, rtol=0)


@pytest.mark.parametrize("lens", LENSES)
def test_resizing_keeps_the_directions_of_pixels(lens):
    large, small = camera(lens), camera(lens).resized(640)
    np.testing.assert_allclose(
        small.project(directions(100))[0] * 2, large.project(directions(100))[0], atol=1e-6
    )


@pytest.mark.parametrize("lens", LENSES)
def test_a_lens_round_trips_through_json(lens):
    assert lens_from(json.loads(json.dumps(lens_values(lens)))) == lens


def test_directions_beyond_the_field_of_view_are_invalid():
    behind = np.array([[0.0, 0, -1], [0.3, 0, -0.1], [0, 0, 1]])
    assert camera(BROWN).project(behind)[1].tolist() == [False, False, True]
    assert camera(F_THETA).project(behind)[1].tolist() == [False, True, True]
    assert not camera(replace(F_THETA, max_angle=0.5)).unproject(np.array([[0.0, 360]]))[1][0]


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        ({"model": "thin_lens"}, "unknown lens model 'thin_lens'; allowed are"),
        ({"model": "fisheye", "k": [0.1]}, "k must be 4 finite numbers"),
        ({"model": "fisheye", "k": [float("nan"), 0, 0, 0]}, "finite"),
        ({"model": "fisheye", "strength": 1}, "unknown .*strength"),
        ({"model": "fisheye", "max_angle": 4.0}, r"max_angle must be in \(0, pi\]"),
        ({"model": "omnidirectional", "xi": -1}, "xi must be finite"),
        ({"model": "omnidirectional", "xi": "far"}, "omnidirectional lens"),
        ({"model": "f_theta", "polynomial": [1.0, 1.0]}, "the first of them 0"),
        ({"model": "f_theta", "linear": [0.0, 0, 0]}, "cannot be inverted"),
        ({"model": "f_theta", "polynomial": [0.0, -1.0]}, "does not grow"),
        ({"model": "brown_conrady", "radial": [-0.9, 0, 0, 0, 0, 0]}, "valid up to 31.3 degrees"),
    ],
)
def test_an_invalid_lens_is_refused_with_the_reason(values, reason):
    with pytest.raises(SceneError, match=reason):
        camera(lens_from(values))


def ncore_camera(golden, name, shutter):
    values = golden["models"][name]
    centre, focal = np.array(values["principal_point"]), values.get("focal_length", [560.0] * 2)
    if name == "brown_conrady":
        lens = BrownConrady(
            tuple(values["radial_coeffs"]),
            tuple(values["tangential_coeffs"]),
            tuple(values["thin_prism_coeffs"]),
        )
    elif name == "fisheye":
        lens = Fisheye(tuple(values["radial_coeffs"]), values["max_angle"])
    else:
        reference = name.removeprefix("f_theta_")
        key = {"angle": "angle_to_pixeldist_poly", "radius": "pixeldist_to_angle_poly"}[reference]
        lens = FTheta.of_pixels(
            tuple(values[key]),
            focal[0],
            reference=reference,
            linear=tuple(values["linear_cde"]),
            max_angle=values["max_angle"],
        )
        centre = centre + 0.5  # NCore keeps this one in pixels counted from centres.
    k = np.array([[focal[0], 0, centre[0]], [0, focal[1], centre[1]], [0, 0, 1]])
    readout = Shutter(shutter, 0 if shutter == "global" else 30_000)
    return Camera("ncore", *golden["size"], k, np.eye(4), lens, readout)


def test_projection_matches_ncore_for_every_lens_and_shutter():
    golden = json.loads((Path(__file__).parent / "ncore_cameras.json").read_text())
    points, compared = np.array(golden["points"]), 0
    for case in golden["cases"]:
        seen_by = ncore_camera(golden, case["model"], case["shutter"])
        end = np.linalg.inv(golden["motions"][case["motion"]])
        motion = CameraMotion(np.eye(4), end if seen_by.shutter.rolls else np.eye(4))
        pixels, valid, _ = project_moving(seen_by, motion, points)
        assert valid[case["seen"]].all()
        np.testing.assert_allclose(pixels[case["seen"]], case["pixels"], atol=0.01, rtol=0)
        compared += len(case["seen"])
    assert compared > 500


@pytest.mark.parametrize("direction", ["top_to_bottom", "bottom_to_top"])
def test_a_rolling_shutter_leans_a_pole_by_speed_and_readout(direction):
    # 15 m/s across the view; a pole 10 m ahead moves by 15 * 0.03 * 900 / 10 px from the first to
    # the last row.
    readout = Shutter(direction, 30_000)
    motion = CameraMotion.about(np.eye(4), np.array([15.0, 0, 0]), np.zeros(3), 0.03)
    pole = np.array([[0.0, y, 10.0] for y in (-3.8, 0, 3.8)])
    pixels, _, times = project_moving(camera(shutter=readout), motion, pole)
    expected = 641.5 - K[0, 0] * 15 * 0.03 * (times - 0.5) / 10
    np.testing.assert_allclose(pixels[:, 0], expected, atol=1e-9)
    assert (pixels[2, 0] - pixels[0, 0] < -20) == (direction == "top_to_bottom")


def test_objects_moving_with_the_camera_do_not_lean():
    motion = CameraMotion.about(np.eye(4), np.array([15.0, 0, 0]), np.zeros(3), 0.03)
    pole = np.array([[0.0, y, 10.0] for y in (-3.8, 0, 3.8)])
    velocities = np.tile([15.0, 0, 0], (3, 1))
    seen_by = camera(shutter=Shutter("top_to_bottom", 30_000))
    pixels = project_moving(seen_by, motion, pole, velocities)[0]
    np.testing.assert_allclose(pixels[:, 0], 641.5, atol=1e-9)


@pytest.mark.parametrize(
    ("direction", "readout_us"),
    [("sideways", 10), ("global", 5), ("top_to_bottom", 0), ("top_to_bottom", 10**6)],
)
def test_an_invalid_shutter_is_refused(direction, readout_us):
    with pytest.raises(SceneError, match="shutter: "):
        Shutter(direction, readout_us)


def test_a_camera_keeps_its_recorded_optics():
    device = Optics(K * [[1.02], [1.02], [1]], BROWN, Shutter("left_to_right", 20_000))
    known = replace(camera(), recorded=device)
    assert known.is_pinhole
    assert known.as_recorded().lens is BROWN
    np.testing.assert_allclose(known.resized(640).as_recorded().K[0], device.K[0] / 2)
