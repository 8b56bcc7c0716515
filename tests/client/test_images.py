from __future__ import annotations

import io

import numpy as np
import pytest
import simplejpeg

from real2sim.errors import ImageDecodeError, MalformedReplyError
from real2sim.images import Image, frame_from_wire, write_atomically
from real2sim_proto.drive import Frame as WireFrame

from .fake_episode import IMAGE, frame


def raw_image(array: np.ndarray, modality: str, dtype: str) -> Image:
    return Image(
        data=array.tobytes(), codec="raw", modality=modality, dtype=dtype, shape=array.shape
    )


def png_image(array: np.ndarray, modality: str, dtype: str) -> Image:
    pillow = pytest.importorskip("PIL.Image")
    buffer = io.BytesIO()
    pillow.fromarray(array).save(buffer, "PNG")
    return Image(data=buffer.getvalue(), codec="png", modality=modality, dtype=dtype)


@pytest.mark.parametrize(
    ("modality", "array"),
    [
        ("rgb", IMAGE),
        ("depth", np.linspace(0, 80, 12, dtype="<f4").reshape(3, 4)),
        ("instance", np.arange(12, dtype="<u2").reshape(3, 4) * 5000),
    ],
)
def test_raw_is_exact_and_not_copied(modality, array):
    image = raw_image(array, modality, str(array.dtype))
    np.testing.assert_array_equal(image.array, array)
    assert image.array is image.array
    assert not image.array.flags.owndata


def test_png_is_exact():
    image = png_image(IMAGE, "rgb", "uint8")
    np.testing.assert_array_equal(image.array, IMAGE)


def test_instance_png_keeps_sixteen_bits():
    ids = np.array([[0, 1], [300, 65535]], np.uint16)
    image = png_image(ids, "instance", "uint16")
    assert image.array.dtype == np.uint16
    np.testing.assert_array_equal(image.array, ids)


def test_depth_png_is_decoded_to_metres():
    image = png_image(np.array([[0, 256], [2560, 65535]], np.uint16), "depth", "uint16")
    assert image.array.dtype == np.float32
    np.testing.assert_allclose(image.array, [[0, 1.0], [10.0, 65535 / 256]])


def test_png_without_a_decoder_says_what_to_install(monkeypatch):
    image = png_image(IMAGE, "rgb", "uint8")
    monkeypatch.setattr("real2sim.images.importlib.util.find_spec", lambda name: None)
    with pytest.raises(ImageDecodeError, match="Pillow or OpenCV") as caught:
        _ = image.array
    assert "pip install pillow" in caught.value.hint
    assert image.data.startswith(b"\x89PNG")


def test_opencv_decodes_png_to_the_same_rgb(monkeypatch):
    pytest.importorskip("cv2")
    coloured = np.zeros((4, 5, 3), np.uint8)
    coloured[..., 0] = 200
    image = png_image(coloured, "rgb", "uint8")
    monkeypatch.setattr(
        "real2sim.images.importlib.util.find_spec", lambda name: None if name == "PIL" else name
    )
    np.testing.assert_array_equal(image.array, coloured)


@pytest.mark.parametrize("codec", ["raw", "jpeg", "png"])
def test_broken_bytes_raise_a_decode_error(codec):
    image = Image(data=b"xyz", codec=codec, modality="rgb", dtype="uint8", shape=(2, 2, 3))
    with pytest.raises(ImageDecodeError):
        _ = image.array


def test_an_image_of_an_unexpected_size_is_refused():
    data = simplejpeg.encode_jpeg(IMAGE)
    image = Image(data=data, codec="jpeg", modality="rgb", dtype="uint8", shape=(480, 640, 3))
    with pytest.raises(ImageDecodeError, match=r"\(48, 64, 3\) where uint8 \(480, 640, 3\)"):
        _ = image.array


def test_a_jpeg_is_saved_unchanged(tmp_path):
    data = simplejpeg.encode_jpeg(IMAGE)
    image = Image(data=data, codec="jpeg", modality="rgb", dtype="uint8")
    assert image.save(tmp_path / "deep" / "a.jpg").read_bytes() == data


def test_raw_rgb_can_be_saved_as_jpeg(tmp_path):
    path = raw_image(IMAGE, "rgb", "uint8").save(tmp_path / "a.jpg")
    decoded = simplejpeg.decode_jpeg(path.read_bytes())
    assert np.abs(decoded.astype(int) - IMAGE).max() <= 8


@pytest.mark.parametrize("library", ["PIL", "cv2"])
def test_raw_rgb_is_saved_losslessly_as_png(tmp_path, monkeypatch, library):
    pytest.importorskip(library)
    monkeypatch.setattr(
        "real2sim.images.importlib.util.find_spec", lambda name: name if name == library else None
    )
    path = raw_image(IMAGE, "rgb", "uint8").save(tmp_path / "a.png")
    again = Image(data=path.read_bytes(), codec="png", modality="rgb", dtype="uint8")
    np.testing.assert_array_equal(again.array, IMAGE)


def test_saving_a_png_without_an_encoder_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setattr("real2sim.images.importlib.util.find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"install Pillow or OpenCV; '\.jpg' needs neither"):
        raw_image(IMAGE, "rgb", "uint8").save(tmp_path / "a.png")


def test_depth_is_saved_as_npy(tmp_path):
    depth = np.linspace(0, 80, 12, dtype=np.float32).reshape(3, 4)
    path = raw_image(depth, "depth", "float32").save(tmp_path / "a.npy")
    np.testing.assert_array_equal(np.load(path), depth)


def test_a_lossy_suffix_is_refused_for_depth(tmp_path):
    image = raw_image(np.zeros((2, 2), np.float32), "depth", "float32")
    with pytest.raises(ValueError, match=r"cannot be written as '\.jpg'; use '\.npy'$"):
        image.save(tmp_path / "a.jpg")
    assert list(tmp_path.iterdir()) == []


def test_a_refused_suffix_lists_each_supported_one_once(tmp_path):
    with pytest.raises(
        ValueError, match=r"as '\.gif'; use '\.jpeg' or '\.jpg' or '\.npy' or '\.png'$"
    ):
        raw_image(IMAGE, "rgb", "uint8").save(tmp_path / "a.gif")


def test_a_failed_write_keeps_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "a"
    write_atomically(path, b"old")

    def fail(*_: object) -> None:
        raise OSError("disk full")

    monkeypatch.setattr("real2sim.images.os.replace", fail)
    with pytest.raises(OSError, match="disk full"):
        write_atomically(path, b"new")
    assert [p.read_bytes() for p in tmp_path.iterdir()] == [b"old"]


@pytest.mark.parametrize("member", ["K", "T_world_sensor"])
@pytest.mark.parametrize("value", [np.eye(2), "matrix", None])
def test_frames_with_broken_matrices_are_malformed(member, value):
    wire = WireFrame.model_validate(frame("raw") | {member: value})
    with pytest.raises(MalformedReplyError, match=member):
        frame_from_wire(wire)


def test_numpy_converts_an_image_to_its_array():
    image = raw_image(IMAGE, "rgb", "uint8")
    np.testing.assert_array_equal(np.asarray(image), IMAGE)
    assert np.asarray(image, dtype=np.float32).dtype == np.float32
    assert np.asarray(image) is image.array


def test_numpy_copies_an_image_on_request():
    image = raw_image(IMAGE, "rgb", "uint8")
    copy = np.array(image, copy=True)
    copy[:] = 0
    np.testing.assert_array_equal(image.array, IMAGE)


@pytest.mark.parametrize(
    ("array", "modality", "dtype"),
    [
        (IMAGE, "rgb", "uint8"),
        (
            np.linspace(0, 80, IMAGE[..., 0].size, dtype="<f4").reshape(IMAGE.shape[:2]),
            "depth",
            "<f4",
        ),
        (np.zeros(IMAGE.shape[:2], "<f4"), "depth", "<f4"),
        (np.arange(IMAGE[..., 0].size, dtype="<u2").reshape(IMAGE.shape[:2]), "instance", "<u2"),
    ],
)
def test_notebooks_display_every_kind_of_image(array, modality, dtype):
    shown = simplejpeg.decode_jpeg(raw_image(array, modality, dtype)._repr_jpeg_())
    assert shown.shape == IMAGE.shape


def test_a_depth_preview_is_brighter_for_nearer_points_and_black_for_misses():
    depth = np.repeat(np.repeat(np.array([[0.0, 5.0, 40.0]], "<f4"), 16, 0), 16, 1)
    shown = simplejpeg.decode_jpeg(raw_image(depth, "depth", "<f4")._repr_jpeg_())[8, 8::16, 0]
    assert shown[0] < 8
    assert shown[1] > shown[2] > shown[0]
