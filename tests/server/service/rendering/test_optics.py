"""Lenses and effects of free cameras over REST."""

import numpy as np
import pytest

from real2sim_proto import ErrorCode, decode

VIEW = "/v1/scenes/tiny/render"
MSGPACK = {"Accept": "application/msgpack"}
FISHEYE = {"model": "fisheye", "k": [0.01, 0, 0, 0], "max_angle": 1.6}
EYE = {
    "name": "eye",
    "width": 64,
    "height": 48,
    "K": [[20.0, 0, 32], [0, 20, 24], [0, 0, 1]],
    "pose": {"position": [1.0, 0, 1.5], "quaternion": [0.5, -0.5, 0.5, -0.5]},
}


def frames(client, **fields):
    answer = client.post(VIEW, json={"cameras": [EYE | fields]}, headers=MSGPACK)
    assert answer.status_code == 200, answer.text
    return decode(answer.content)["frames"]


def image(frame):
    return np.frombuffer(frame["data"], frame["dtype"]).reshape(frame["shape"])


def test_a_fisheye_view_is_circular_and_names_its_lens(client):
    rgb, depth = frames(client, lens=FISHEYE, modalities=["rgb", "depth"])
    assert (rgb["lens"], depth["lens"]) == ("fisheye", "fisheye")
    assert not image(rgb)[0, 0].any()
    assert image(rgb)[24, 32].any()
    assert image(depth)[0, 0] == 0


def test_effects_change_colours_only_and_are_listed(client):
    plain = frames(client, modalities=["rgb", "depth"])
    bright = frames(client, modalities=["rgb", "depth"], effects={"exposure_ev": 1.0})
    assert "effects" not in plain[0]
    assert bright[0]["effects"] == ["exposure_ev"]
    assert "effects" not in bright[1]
    assert image(bright[0]).mean() > image(plain[0]).mean() * 1.1
    np.testing.assert_array_equal(image(bright[1]), image(plain[1]))


@pytest.mark.parametrize(
    ("lens", "said"),
    [
        ({"model": "brown_conrady", "radial": [-2.0, 0, 0, 0, 0, 0]}, "valid up to"),
        ({"model": "f_theta", "polynomial": [0.0, -1.0]}, "does not grow"),
        ({"model": "fish"}, "lens"),
        ({"model": "fisheye", "k": [1.0]}, "k"),
    ],
)
def test_an_invalid_lens_is_refused_with_the_reason(client, lens, said):
    answer = client.post(VIEW, json={"cameras": [EYE | {"lens": lens}]})
    assert answer.status_code in {400, 422}
    assert answer.json()["code"] == ErrorCode.INVALID_REQUEST
    assert said in answer.text
