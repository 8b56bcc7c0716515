"""Sensors of a session with lenses, shutters and effects."""

from __future__ import annotations

import numpy as np
import pytest

from real2sim_server.render.frame import warm_up_lenses

pytestmark = pytest.mark.network

RESET = {"action": "control", "dt_us": 100_000}
ROLLING = {
    "K": [[40.0, 0, 48], [0, 40, 32], [0, 0, 1]],
    "lens": {"model": "fisheye", "k": [0.0, 0.0, 0.0, 0.0]},
    "shutter": {"direction": "top_to_bottom", "readout_us": 30_000},
}
NOISE = {"noise": {"photon": 0.001, "read": 0.01}}


@pytest.fixture(autouse=True, scope="module")
def lens_kernels():
    """Cache the kernels on disk, so that no reset waits for them."""
    warm_up_lenses("cpu")


def image(frame):
    return np.frombuffer(frame["data"], frame["dtype"]).reshape(frame["shape"])


def drive(join, site, **sensor):
    """Frames of a reset and a step."""
    planner = join(site.create(RESET))
    obs = planner.reset(sensors=[{"camera": "front", "codec": "raw"} | sensor])
    return obs["frames"][0], planner.act(0)["frames"][0]


def test_frames_report_their_lens_shutter_and_effects(site, join):
    _, plain = drive(join, site)
    _, seen = drive(join, site, optics=ROLLING, effects=NOISE)
    assert (seen["lens"], seen["shutter"], seen["effects"]) == (
        "fisheye",
        "top_to_bottom",
        ["noise"],
    )
    assert not {"lens", "shutter", "effects"} & set(plain)
    np.testing.assert_allclose(np.asarray(seen["K"]), ROLLING["K"])
    assert (image(seen) != image(plain)).mean() > 0.2


def test_a_repeated_drive_gives_identical_pixels(site, join):
    both = [drive(join, site, optics=ROLLING, effects=NOISE)[1] for _ in range(2)]
    np.testing.assert_array_equal(*map(image, both))


def test_motion_blur_changes_the_image(site, join):
    blur = {"motion_blur": {"exposure_us": 100_000, "samples": 3}}
    (_, sharp), (_, blurred) = drive(join, site), drive(join, site, effects=blur)
    assert blurred["effects"] == ["motion_blur"]
    assert (image(sharp) != image(blurred)).any()
