"""Calibration jobs over REST."""

from __future__ import annotations

import pytest

from ..waiting import finished
from .test_simulations import PUSH, edit, scenario

__all__ = ["scenario"]

BOXES = [{"t_us": t, "position": [14.0 + 6.6e-6 * t, -3.0, 0.75]} for t in (50_000, 100_000)]
SMALL = {"preset": "paper", "max_particles": 1000, "gravity": [0, 0, 0], "background": False}


def asked(**changes):
    return {
        "object_id": "car_red",
        "parameters": ["speed"],
        "observations": {"boxes": BOXES, "position_sigma": 0.01},
        "simulate": SMALL,
    } | changes


def test_boxes_determine_the_speed_of_a_pushed_car_but_not_its_stiffness(client, scenario):
    edit(client, scenario, PUSH)
    body = asked(parameters=["speed", "stiffness"])
    job = finished(client, client.post(f"{scenario}/calibrate", json=body))
    assert (job["state"], job["kind"]) == ("succeeded", "calibrate"), job
    result = job["result"]
    assert result["factors"]["speed"] == pytest.approx(1.1, rel=0.02)
    assert result["values"]["speed"] == pytest.approx(6.6, rel=0.02)
    assert (result["untold"], result["uncertainty"]["stiffness"]) == (["stiffness"], None)


def test_a_parameter_that_no_observation_determines_fails_the_job(client, scenario):
    edit(client, scenario, PUSH)
    body = asked(parameters=["yield_stress"])
    job = finished(client, client.post(f"{scenario}/calibrate", json=body))
    assert job["state"] == "failed"
    assert "do not determine yield_stress" in job["error"]["detail"]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"object_id": "nobody"}, "nobody"),
        ({"observations": {}}, "nothing was observed"),
        ({"parameters": ["colour"]}, "parameters"),
        ({"observations": {"boxes": [{"t_us": -1, "position": [0, 0, 0]}]}}, "begins at 0 us"),
    ],
)
def test_invalid_calibrations_are_refused_immediately(client, scenario, changes, words):
    answer = client.post(f"{scenario}/calibrate", json=asked(**changes))
    assert answer.status_code in {404, 422}, answer.text
    assert words in answer.text
