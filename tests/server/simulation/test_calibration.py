"""An object's parameters are recovered from boxes, points and images, within uncertainty."""

from __future__ import annotations

import base64
import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from real2sim_proto.jobs import Observations
from real2sim_server.edit.state import ScenarioState
from real2sim_server.physics import FixedCorotated, PhysicsError, Plane
from real2sim_server.physics.fitting import fit
from real2sim_server.scene import SceneObject
from real2sim_server.simulation.calibration import (
    BoxTrack,
    MarkedPoints,
    ObservedImages,
    Simulated,
    calibrate_object,
    drawn,
    observations_of,
)
from real2sim_server.simulation.particles import Embedding
from real2sim_server.simulation.result import Playback
from real2sim_server.simulation.rollout import SimulateOptions, simulate
from real2sim_server.simulation.structure import ObjectPhysics
from tests.server.conftest import box_cloud, make_tiny_scene, standing

SIZE = (0.8, 0.6, 0.6)
SOFT = FixedCorotated(young=1e5, poisson=0.3, density=200, viscosity=200)
TRUE = {"stiffness": 1.3, "friction": 0.8, "speed": 1.1}
TIMES = np.arange(1, 6) * 0.0125
PLACES = np.array([[0.35, 0.2, 0.2], [-0.35, -0.2, 0.25], [0.3, -0.25, -0.2], [-0.3, 0.2, -0.2]])


@pytest.fixture(scope="module")
def scene():
    tiny = make_tiny_scene()
    cloud = box_cloud(400, SIZE, (0.9, 0.1, 0.1), seed=5)
    block = SceneObject("block", "box", SIZE, cloud, standing(4.0, 0.0, 0.37))
    return replace(tiny, objects={"block": block})


@pytest.fixture(scope="module")
def state(scene):
    return ScenarioState.of(scene)


def thrown(stiffness=1.0, friction=1.0, speed=1.0, **changes) -> SimulateOptions:
    """A soft block sliding onto the ground, with the true values or others."""
    own = ObjectPhysics(
        material=replace(SOFT, young=stiffness * SOFT.young),
        friction=0.4 * friction,
        velocity=speed * np.array([3.0, 0.5, -3.0]),
        **changes,
    )
    ground = Plane(name="ground")
    return SimulateOptions(
        preset="paper", objects={"block": own}, colliders=[ground], road=(), times_s=tuple(TIMES)
    )


@pytest.fixture(scope="module")
def truth(scene, state):
    return simulate(scene, state, thrown(**TRUE))


def points_of(result, sigma=0.005) -> MarkedPoints:
    own = result.objects["block"]
    follow = Embedding(own.rest.astype(float), PLACES, spacing=own.spacing).follow
    seen = []
    for frame in range(1, result.frames):
        moved = own.displacements(frame)
        local = follow(np.zeros(own.rest.shape) if moved is None else moved).positions
        pose = own.transform(frame)
        seen.append(local @ pose[:3, :3].T + pose[:3, 3])
    positions = np.array(seen)
    positions[1, 2] = np.nan
    return MarkedPoints(PLACES, result.times_s[1:], positions, sigma)


def boxes_of(result) -> BoxTrack:
    own = result.objects["block"]
    return BoxTrack(result.times_s[1:], own.positions[1:], own.quaternions[1:], position_sigma=0.01)


def images_of(scene, state, result) -> ObservedImages:
    playback, frames = Playback(scene, state, result), (3, 5)
    camera = scene.rig.cameras[0]
    images = [drawn(playback, f, camera, np.eye(4)) for f in frames]
    times = result.times_s[list(frames)]
    return ObservedImages(times, [camera] * 2, np.stack([np.eye(4)] * 2), images, sigma=0.02)


def calibrated(scene, state, observation, *parameters):
    return calibrate_object(
        scene, state, thrown(), "block", [observation], parameters=parameters
    ).fit


def within(found, name, deviations=1.0) -> bool:
    """Whether a factor is right within that many of the claimed standard deviations."""
    return abs(found.factors[name] / TRUE[name] - 1) < deviations * found.uncertainty[name]


def test_marked_points_determine_stiffness_friction_and_speed(scene, state, truth):
    found = calibrated(scene, state, points_of(truth), *TRUE)
    assert found.residual[-1] < 0.2 * found.residual[0]
    for name, factor in TRUE.items():
        assert found.factors[name] == pytest.approx(factor, rel=0.1), name
        assert within(found, name), name
        assert found.observation[name] < found.uncertainty[name] < 1


def test_boxes_determine_speed_but_not_yield_stress(scene, state, truth):
    found = calibrated(scene, state, boxes_of(truth), "speed", "yield_stress")
    assert found.undetermined == ["yield_stress"]
    assert found.factors["yield_stress"] == 1.0
    assert within(found, "speed")
    assert found.factors["speed"] == pytest.approx(TRUE["speed"], rel=0.06)


def test_small_images_determine_speed(scene, state, truth, worker_kernels):
    found = calibrated(scene, state, images_of(scene, state, truth), "speed")
    assert found.factors["speed"] == pytest.approx(TRUE["speed"], rel=0.06)
    assert within(found, "speed")


@pytest.mark.slow
def test_parameters_observed_on_half_size_cells_are_found_within_uncertainty(scene, state):
    """Most of the uncertainty comes from the cells; observations alone would claim too much.

    Two standard deviations cover 19 of 20 measurements; here the cells really differ.
    """
    finer = simulate(scene, state, thrown(**TRUE, grid=16))
    observed = points_of(finer)
    coarse = thrown()
    own = replace(coarse.objects["block"], grid=None)
    found = calibrate_object(
        scene,
        state,
        replace(coarse, objects={"block": own}),
        "block",
        [observed],
        parameters=["stiffness", "speed"],
    ).fit
    for name in ("stiffness", "speed"):
        assert within(found, name, 2.0), name
    assert found.discretisation["stiffness"] > found.observation["stiffness"]


def test_uninformative_observations_are_refused(scene, state, truth):
    with pytest.raises(PhysicsError, match="do not determine yield_stress"):
        calibrated(scene, state, boxes_of(truth), "yield_stress")


@pytest.mark.parametrize(
    ("parameters", "message"),
    [(["colour"], "cannot fit .*allowed are stiffness"), ([], "allowed are")],
)
def test_parameters_that_cannot_be_fitted_are_named(scene, state, truth, parameters, message):
    with pytest.raises(PhysicsError, match=message):
        calibrated(scene, state, boxes_of(truth), *parameters)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"boxes": [{"t_us": -5, "position": [0, 0, 0]}]}, "the simulation begins at 0 us"),
        ({"boxes": [{"t_us": 10**9, "position": [0, 0, 0]}]}, "over 30 s at most"),
        ({"images": [{"t_us": 1, "camera": "rear", "image": ""}]}, "the scene has front, left"),
        ({"images": [{"t_us": 1, "camera": "front", "image": "??"}]}, "not base64"),
        ({"images": [{"t_us": 1, "camera": "front", "image": "AAAA"}]}, "neither PNG nor JPEG"),
        ({"points": [{"place": [0, 0, 0], "seen": []}]}, "at least 1 item"),
        ({}, "nothing was observed"),
    ],
)
def test_invalid_observations_are_refused(scene, state, given, message):
    [subject] = state.visible
    with pytest.raises((PhysicsError, ValueError), match=message):
        observations_of(Observations.model_validate(given), scene, subject, 0, 10**6)


def test_all_kinds_of_observations_are_read(scene, state):
    [subject] = state.visible
    png = cv2.imencode(".png", np.full((128, 192, 3), (1, 2, 3), np.uint8))[1].tobytes()
    given = {
        "recorded": True,
        "boxes": [
            {"t_us": 1000, "position": [1, 2, 3]},
            {"t_us": 2000, "position": [1, 2, 3], "size": [1, 1, 1], "quaternion": [1, 0, 0, 0]},
        ],
        "points": [{"place": [0, 0, 0], "seen": [{"t_us": 500, "position": [0, 0, 0]}]}],
        "images": [{"t_us": 0, "camera": "front", "image": base64.b64encode(png).decode("ascii")}],
    }
    given = Observations.model_validate_json(json.dumps(given))
    found = observations_of(given, scene, subject, 0, 2_000_000)
    assert [type(o).__name__ for o in found] == ["BoxTrack"] * 3 + [
        "MarkedPoints",
        "ObservedImages",
    ]
    image = found[-1].images[0]
    assert (image.shape, image[0, 0].tolist()) == ((64, 96, 3), [3, 2, 1])


def test_boxes_get_shorter_when_an_object_is_crushed(scene, state, truth):
    own = truth.objects["block"]
    sizes = np.array([SIZE] * 5)
    track = BoxTrack(truth.times_s[1:], own.positions[1:], sizes=sizes, size_sigma=1.0)
    [subject] = state.visible
    off = track.differences(Simulated(scene, state, subject, truth)).reshape(5, 6)
    assert off[:, 2].min() < -0.02


def test_fitting_a_line_gives_the_least_squares_uncertainty():
    x = np.linspace(1, 2, 20)

    def residuals(factors, coarser):
        return (factors["a"] * x + 0.1 * coarser * x - 2 * x) / 0.1

    found = fit(residuals, ["a"])
    assert found.factors["a"] == pytest.approx(1.9, rel=1e-3)
    assert found.observation["a"] == pytest.approx(0.1 / np.sqrt(x @ x) / 1.9, rel=0.05)
    # On infinitely small cells it would be 2.0.
    assert found.discretisation["a"] == pytest.approx(0.1 / 1.9, rel=0.1)
