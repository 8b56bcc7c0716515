from __future__ import annotations

import numpy as np
import pytest

from real2sim_server.reconstruct.initialise.views import ProjectedView, SkySamples
from real2sim_server.scene import Camera
from real2sim_server.scene.camera import T_VEHICLE_OPTICAL
from real2sim_server.scene.scene import face_directions

WHITE, TREE = 250, 30
CAMERA = Camera(
    "front", 64, 64, np.array([[60.0, 0, 32], [0, 60, 32], [0, 0, 1]]), T_VEHICLE_OPTICAL
)
NONE, ALL = (np.full((64, 64), value) for value in (False, True))


def view(grey: int, *, covered: bool = False) -> ProjectedView:
    """A uniformly coloured view straight ahead."""
    depth = np.full((32, 32), 20.0 if covered else np.inf, np.float32)
    image = np.full((64, 64, 3), grey, np.uint8)
    nothing = np.zeros((32, 32), np.bool_)
    return ProjectedView(CAMERA, 0, np.linalg.inv(T_VEHICLE_OPTICAL), image, depth, nothing)


def ahead(samples: SkySamples) -> float:
    """Grey level of the sky straight ahead, 0 to 255."""
    faces = samples.finish(np.zeros(3, np.float32)).faces
    return float(faces[0, 8, 8, 0]) * 255


@pytest.mark.parametrize("first", [0, 1])
def test_masked_sky_samples_take_precedence(first):
    seen = [(view(WHITE, covered=True), ALL), (view(TREE), NONE), (view(TREE), NONE)]
    samples = SkySamples(16)
    for one, sky in seen[first:] + seen[:first]:
        samples.add(one, sky)
    assert ahead(samples) == pytest.approx(WHITE, abs=1)


def test_without_a_mask_uncovered_pixels_are_sampled():
    samples = SkySamples(16)
    samples.add(view(WHITE, covered=True), NONE)
    samples.add(view(TREE), NONE)
    assert ahead(samples) == pytest.approx(TREE, abs=1)


def test_unseen_directions_continue_the_sky_and_not_what_stands_before_it():
    samples = SkySamples(16)
    rows = np.arange(64)[:, None]
    horizon = np.where(rows < 24, WHITE, TREE) + np.zeros((1, 64))
    looking = view(WHITE)
    looking.image[:] = horizon[..., None]
    samples.add(looking, horizon == WHITE)
    faces = samples.finish(np.zeros(3, np.float32)).faces
    low = face_directions(16)[..., 2]
    beside = np.abs(face_directions(16)[..., 0]) < 0.5
    unseen = faces.numpy()[beside & (low > 0.05)]
    assert np.allclose(unseen * 255, WHITE, atol=2)
