"""Generate ncore_cameras.json: points projected with the camera models of NVIDIA's NCore.

Requires ``nvidia-ncore`` (19.8.3, Apache-2.0), which is not a dependency of the project. Usage:
``python make_ncore_cameras.py ncore_cameras.json [points]``. Numbers are float64. Image coordinates
have pixel centres at +0.5, as in this project.
"""

import functools
import json
import sys

import numpy as np
import torch
from ncore import data, sensors

SIZE = np.array([1280, 720], np.uint64)
SHUTTERS = {
    "top_to_bottom": data.ShutterType.ROLLING_TOP_TO_BOTTOM,
    "bottom_to_top": data.ShutterType.ROLLING_BOTTOM_TO_TOP,
    "left_to_right": data.ShutterType.ROLLING_LEFT_TO_RIGHT,
    "right_to_left": data.ShutterType.ROLLING_RIGHT_TO_LEFT,
    "global": data.ShutterType.GLOBAL,
}
FORWARD = data.FThetaCameraModelParameters.PolynomialType.ANGLE_TO_PIXELDIST
BACKWARD = data.FThetaCameraModelParameters.PolynomialType.PIXELDIST_TO_ANGLE


def f32(*values):
    return np.array(values, np.float32)


def models(shutter):
    common = {"resolution": SIZE, "shutter_type": shutter, "external_distortion_parameters": None}
    # Fitted inverse polynomial, the initial value of Newton's method.
    angle = np.linspace(0, 1.9, 400)
    forward = [0.0, 560.0, 4.0, -9.0, 2.0, -0.3]
    radius = np.polynomial.polynomial.polyval(angle, forward)
    basis = np.stack([radius**k for k in range(1, 6)], 1)
    fitted = [0.0, *np.linalg.lstsq(basis, angle, rcond=None)[0]]
    theta = {
        "principal_point": f32(640.7, 355.2),
        "angle_to_pixeldist_poly": f32(*forward),
        "pixeldist_to_angle_poly": f32(*fitted),
        "max_angle": 1.8,
        "linear_cde": f32(1.002, 0.0007, -0.0004),
    }
    return {
        "brown_conrady": data.OpenCVPinholeCameraModelParameters(
            **common,
            principal_point=f32(640.5, 361.25),
            focal_length=f32(900, 880),
            radial_coeffs=f32(0.11, -0.09, 0.01, 0.12, -0.02, 0.004),
            tangential_coeffs=f32(0.001, -0.0007),
            thin_prism_coeffs=f32(0.0005, -0.0003, 0.0002, 0.0001),
        ),
        "fisheye": data.OpenCVFisheyeCameraModelParameters(
            **common,
            principal_point=f32(641, 358.5),
            focal_length=f32(420, 424),
            radial_coeffs=f32(0.02, -0.01, 0.003, -0.0005),
            max_angle=1.7,
        ),
        "f_theta_angle": data.FThetaCameraModelParameters(
            **common, **theta, reference_poly=FORWARD
        ),
        "f_theta_radius": data.FThetaCameraModelParameters(
            **common, **theta, reference_poly=BACKWARD
        ),
    }


def values(given):
    found = {}
    for name in vars(given):
        value = getattr(given, name)
        if isinstance(value, np.ndarray):
            found[name] = np.asarray(value, np.float64).tolist()
        elif isinstance(value, float):
            found[name] = float(np.float32(value))
    return found


def sees(parameters, points, start, end):
    kind = sensors.CameraModel.from_parameters
    if isinstance(parameters, data.FThetaCameraModelParameters):
        # The default of three Newton steps is not enough near the edge of the field of view.
        kind = functools.partial(sensors.FThetaCameraModel, newton_iterations=20)
    model = kind(parameters, device="cpu", dtype=torch.float64)
    seen = model.world_points_to_image_points_shutter_pose(
        points, start, end, stop_t_delta=1e-9, return_valid_indices=True
    )
    return seen.valid_indices.numpy(), seen.image_points.numpy()


def main(path, count):
    rng = np.random.default_rng(7)
    towards = rng.normal(size=(count, 3)) * [1.0, 0.6, 0.3] + [0, 0, 0.8]
    points = towards / np.linalg.norm(towards, axis=1, keepdims=True)
    points *= rng.uniform(4, 60, (count, 1))
    still, ahead, turning = np.eye(4), np.eye(4), np.eye(4)
    ahead[:3, 3] = [-0.1, 0.02, -0.45]  # 15 m/s along z for 30 ms, T_camera_world
    c, s = np.cos(0.016), np.sin(0.016)  # 30 degrees/s for 30 ms
    turning[:3, :3] = [[c, 0, -s], [0, 1, 0], [s, 0, c]]
    cases = []
    for shutter, kind in SHUTTERS.items():
        for name, parameters in models(kind).items():
            for motion, end in (("ahead", ahead), ("turning", turning)):
                index, pixels = sees(parameters, points, still, end)
                cases.append(
                    {
                        "model": name,
                        "shutter": shutter,
                        "motion": motion,
                        "seen": index.tolist(),
                        "pixels": np.round(pixels, 5).tolist(),
                    }
                )
    everything = {
        "origin": "nvidia-ncore 19.8.3 by make_ncore_cameras.py",
        "size": SIZE.tolist(),
        "models": {name: values(given) for name, given in models(SHUTTERS["global"]).items()},
        "motions": {"ahead": ahead.tolist(), "turning": turning.tolist()},
        "points": points.tolist(),
        "cases": cases,
    }
    with open(path, "w") as file:
        json.dump(everything, file)


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]) if len(sys.argv) > 2 else 40)
