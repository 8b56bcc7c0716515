from __future__ import annotations

import cv2
import numpy as np
import pytest

from real2sim_server.render.video import VideoError, video_file

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


def test_nothing_is_said_on_standard_error(tmp_path, capfd):
    write(tmp_path / "film.webm")
    assert capfd.readouterr().err == ""


def test_a_webm_file_says_that_it_is_one(tmp_path):
    write(tmp_path / "film.webm")
    header = (tmp_path / "film.webm").read_bytes()[:64]
    assert b"\x42\x82\x88webm\0" in header
    assert b"matroska" not in header


def test_odd_sizes_lose_their_last_row_and_column(tmp_path):
    write(tmp_path / "film.webm", [np.zeros((49, 65, 3), np.uint8)])
    film = cv2.VideoCapture(str(tmp_path / "film.webm"))
    assert film.read()[1].shape == (48, 64, 3)


def test_a_film_that_breaks_off_leaves_the_one_before(tmp_path):
    write(tmp_path / "film.webm")
    before = (tmp_path / "film.webm").read_bytes()
    with pytest.raises(ValueError, match="unpack"):
        write(tmp_path / "film.webm", [FRAMES[0], np.zeros((), np.uint8)])
    assert [file.name for file in tmp_path.iterdir()] == ["film.webm"]
    assert (tmp_path / "film.webm").read_bytes() == before


def test_other_containers_are_refused(tmp_path):
    with pytest.raises(VideoError, match=r"\.webm or \.mp4"):
        write(tmp_path / "film.avi")


def test_a_frame_may_be_changed_once_it_is_added(tmp_path):
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


def test_a_frame_that_cannot_be_encoded_is_an_error_and_leaves_no_file(tmp_path):
    frames = [FRAMES[0], np.zeros((48, 64, 3), np.complex128)]
    with pytest.raises(cv2.error):
        write(tmp_path / "film.webm", frames)
    assert list(tmp_path.iterdir()) == []
