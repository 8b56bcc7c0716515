from __future__ import annotations

import contextlib
import errno
import resource

import cv2
import numpy as np
import pytest

from real2sim_server.render import images as video_module
from real2sim_server.render.images import VideoError, video_file

FRAMES = [np.full((48, 64, 3), (40 * k, 0, 200), np.uint8) for k in range(5)]


def write(path, frames=FRAMES):
    with video_file(path, frames_per_second=10.0) as video:
        for frame in frames:
            video.add(frame)


@pytest.mark.parametrize("suffix", ["webm", "mp4"])
def test_frames_come_back_in_order_and_color(tmp_path, suffix):
    write(tmp_path / f"film.{suffix}")
    film = cv2.VideoCapture(str(tmp_path / f"film.{suffix}"))
    read = []
    while True:
        more, frame = film.read()
        if not more:
            break
        read.append(frame[24, 32, ::-1].astype(int))
    assert film.get(cv2.CAP_PROP_FPS) == pytest.approx(10.0)
    assert np.array(read) == pytest.approx(np.array([f[0, 0] for f in FRAMES]), abs=12)


def test_writing_a_video_prints_nothing_to_stderr(tmp_path, capfd):
    write(tmp_path / "film.webm")
    assert capfd.readouterr().err == ""


def test_webm_files_have_the_webm_doctype(tmp_path):
    write(tmp_path / "film.webm")
    header = (tmp_path / "film.webm").read_bytes()[:64]
    assert b"\x42\x82\x88webm\0" in header
    assert b"matroska" not in header


def test_odd_sizes_lose_their_last_row_and_column(tmp_path):
    write(tmp_path / "film.webm", [np.zeros((49, 65, 3), np.uint8)])
    film = cv2.VideoCapture(str(tmp_path / "film.webm"))
    assert film.read()[1].shape == (48, 64, 3)


def test_a_failed_write_keeps_the_previous_file(tmp_path):
    write(tmp_path / "film.webm")
    before = (tmp_path / "film.webm").read_bytes()
    with pytest.raises(ValueError, match="unpack"):
        write(tmp_path / "film.webm", [FRAMES[0], np.zeros((), np.uint8)])
    assert [file.name for file in tmp_path.iterdir()] == ["film.webm"]
    assert (tmp_path / "film.webm").read_bytes() == before


def test_other_containers_are_refused(tmp_path):
    with pytest.raises(VideoError, match=r"\.webm or \.mp4"):
        write(tmp_path / "film.avi")


def test_added_frames_can_be_modified(tmp_path):
    frame = np.full((48, 64, 3), 200, np.uint8)
    with video_file(tmp_path / "film.webm", frames_per_second=10.0) as video:
        for _ in range(40):
            frame[:] = 200
            video.add(frame)
            frame[:] = 0
    film = cv2.VideoCapture(str(tmp_path / "film.webm"))
    read = [film.read() for _ in range(41)]
    assert [more for more, _ in read] == [True] * 40 + [False]
    assert min(image.mean() for more, image in read if more) > 180


def test_an_invalid_frame_raises_and_leaves_no_file(tmp_path):
    frames = [FRAMES[0], np.zeros((48, 64, 3), np.complex128)]
    with pytest.raises(cv2.error):
        write(tmp_path / "film.webm", frames)
    assert list(tmp_path.iterdir()) == []


@contextlib.contextmanager
def files_of_at_most(size):
    """Limit file sizes of this process to ``size`` bytes within the block."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def refused(number):
    """Expect an OSError with this errno."""
    return pytest.raises(OSError, match=rf"\[Errno {number}\]")


@pytest.mark.parametrize("suffix", ["webm", "mp4"])
def test_an_incomplete_write_raises_and_leaves_no_file(tmp_path, suffix):
    noise = np.random.default_rng(0).integers(0, 255, (30, 96, 160, 3), np.uint8)
    path = tmp_path / f"film.{suffix}"
    write(path, noise)
    size = path.stat().st_size
    path.unlink()
    for share in (0.0, 0.01, 0.3, 0.99):
        with files_of_at_most(int(share * size)), refused(errno.EFBIG):
            write(path, noise)
        assert list(tmp_path.iterdir()) == []
    with files_of_at_most(size):
        write(path, noise)


def test_a_file_that_cannot_be_opened_raises_the_os_error(tmp_path):
    with refused(errno.ENAMETOOLONG):
        write(tmp_path / f"{'x' * 300}.webm")


def test_a_missing_opencv_encoder_is_refused(tmp_path, monkeypatch):
    monkeypatch.setitem(video_module.FOURCC_BY_SUFFIX, ".webm", "????")
    with pytest.raises(VideoError, match="encoder"):
        write(tmp_path / "film.webm")
    assert list(tmp_path.iterdir()) == []
