"""Camera effects: exposure, white balance, vignetting, noise, tone curve and JPEG."""

import numpy as np
import pytest
from pydantic import ValidationError

from real2sim_proto.sensors import CameraEffects
from real2sim_server.render.images import to_display, to_light, with_effects

GREY = np.full((40, 60, 3), 100, np.uint8)
RAMP = np.tile(np.arange(256, dtype=np.uint8)[None, :, None], (8, 1, 3))


def seen(rgb, t_us=0, camera="front", **effects):
    return with_effects(rgb, CameraEffects(**effects), camera, t_us)


def test_no_effects_leave_the_image_unchanged():
    np.testing.assert_array_equal(seen(RAMP), RAMP)
    assert CameraEffects().names == []


def test_one_stop_of_exposure_doubles_the_light():
    bright = to_light(seen(GREY, exposure_ev=1.0)).mean()
    assert bright == pytest.approx(2 * to_light(GREY).mean(), rel=0.01)
    assert (seen(RAMP, exposure_ev=8.0)[:, 100:] == 255).all()


def test_white_balance_gains_each_colour():
    light = to_light(seen(GREY, white_balance=(2.0, 1.0, 0.5))).mean((0, 1))
    np.testing.assert_allclose(light / to_light(GREY).mean(), [2, 1, 0.5], rtol=0.02)


def test_vignetting_darkens_only_the_corners():
    image = seen(GREY, vignetting=(-0.5, 0.0, 0.0))
    assert abs(int(image[20, 30, 0]) - 100) <= 1
    share = to_light(image)[0, 0, 0] / to_light(GREY)[0, 0, 0]
    assert share == pytest.approx(0.5, abs=0.03)


def test_noise_has_photon_and_read_variance():
    flat = np.full((200, 200, 3), 150, np.uint8)
    light = to_light(flat).mean()
    spread = to_light(seen(flat, noise={"photon": 0.001, "read": 0.005})).std()
    assert spread == pytest.approx((0.001 * light + 0.005**2) ** 0.5, rel=0.05)


def test_noise_depends_on_seed_time_and_camera():
    noise = {"noise": {"photon": 0.002, "read": 0.01, "seed": 3}}
    first = seen(GREY, **noise)
    np.testing.assert_array_equal(first, seen(GREY, **noise))
    others = [seen(GREY, t_us=1, **noise), seen(GREY, camera="rear", **noise)]
    others.append(seen(GREY, noise={"photon": 0.002, "read": 0.01, "seed": 4}))
    for other in others:
        assert (first != other).mean() > 0.3


def test_a_tone_curve_maps_display_values():
    bent = seen(RAMP, tone_curve=[0.0, 0.2, 1.0])[0, :, 0].astype(int)
    assert bent[0] == 0
    assert bent[255] == 255
    assert abs(bent[128] - 51) <= 2
    assert (np.diff(bent) >= 0).all()


def test_low_jpeg_quality_adds_artefacts():
    pattern = np.random.default_rng(0).integers(0, 255, (64, 64, 3)).astype(np.uint8)
    rough, fine = (np.abs(seen(pattern, jpeg_quality=q).astype(int) - pattern) for q in (10, 95))
    assert rough.mean() > 4 * fine.mean() > 0


def test_light_conversion_round_trips():
    np.testing.assert_array_equal(to_display(to_light(RAMP)), RAMP)


def test_active_effects_are_named_in_order():
    on = CameraEffects(jpeg_quality=80, exposure_ev=0.5, noise={"read": 0.1})
    assert on.names == ["exposure_ev", "noise", "jpeg_quality"]


@pytest.mark.parametrize(
    "wrong",
    [
        {"exposure_ev": 30},
        {"exposure_ev": float("nan")},
        {"white_balance": [1.0, 0.0, 1.0]},
        {"noise": {"photon": -1}},
        {"tone_curve": [0.0, 0.8, 0.5]},
        {"tone_curve": [0.0]},
        {"vignetting": [1e9, 0, 0]},
        {"jpeg_quality": 0},
        {"motion_blur": {"exposure_us": 1000, "samples": 1000}},
        {"bloom": 1},
    ],
)
def test_invalid_effects_are_refused(wrong):
    with pytest.raises(ValidationError):
        CameraEffects.model_validate(wrong)
