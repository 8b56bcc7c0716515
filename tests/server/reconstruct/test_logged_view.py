from __future__ import annotations

import numpy as np
import pytest

from real2sim_server.geometry import box_corners
from real2sim_server.logs import ObjectTrack
from real2sim_server.reconstruct.logged_view import box_outline, moving_tracks, tracks_mask
from real2sim_server.scene import Camera, Trajectory

from .conftest import painted_log

K = np.array([[100.0, 0, 60], [0, 100, 40], [0, 0, 1]])
CAMERA = Camera("front", 120, 80, K, np.eye(4))


def box(centre, size) -> ObjectTrack:
    pose = np.eye(4)
    pose[:3, 3] = centre
    times = np.array([0, 1000])
    return ObjectTrack("box_0", "box", size, Trajectory.from_transforms(times, [pose, pose]))


def test_a_box_seen_frontally_covers_its_nearer_face():
    # Camera and box axes agree: 2 m wide, 1 m high, front face at 9.5 m; 1 m is 100 / 9.5 px.
    mask = tracks_mask((box((0, 0, 10), (2.0, 1.0, 1.0)),), CAMERA, np.eye(4), 0)
    rows, columns = np.nonzero(mask)
    half = 100 / 9.5
    assert (columns.min(), columns.max() + 1) == (round(60 - half), round(60 + half))
    assert (rows.min(), rows.max() + 1) == (round(40 - half / 2), round(40 + half / 2))
    assert mask.sum() == (np.ptp(columns) + 1) * (np.ptp(rows) + 1)


def test_a_box_behind_the_camera_covers_nothing():
    assert not tracks_mask((box((0, 0, -10), (2.0, 1.0, 1.0)),), CAMERA, np.eye(4), 0).any()


def test_a_box_around_the_image_plane_is_cut_not_mirrored():
    # Beside the camera from 5 m behind it to 5 m before it: only the right half can show it.
    mask = tracks_mask((box((2, 0, 0), (2.0, 1.0, 10.0)),), CAMERA, np.eye(4), 0)
    assert mask.any()
    assert not mask[:, :60].any()
    # Its far inner edge, 1 m to the right at 5 m, is where it begins.
    assert np.nonzero(mask.any(axis=0))[0].min() == 80


def test_a_track_counts_only_when_it_is_there():
    track = box((0, 0, 10), (2.0, 1.0, 1.0))
    assert tracks_mask((track,), CAMERA, np.eye(4), 30_000).any()
    assert not tracks_mask((track,), CAMERA, np.eye(4), 300_000).any()


def test_every_pixel_with_its_centre_in_the_hull_of_a_turned_box_is_set():
    pose = np.eye(4)
    angle = 0.6
    pose[:3, :3] = [
        [np.cos(angle), 0, np.sin(angle)],
        [0, 1, 0],
        [-np.sin(angle), 0, np.cos(angle)],
    ]
    pose[:3, 3] = (0.5, 0.4, 6)
    track = ObjectTrack(
        "b", "box", (3.0, 1.0, 1.5), Trajectory.from_transforms(np.array([0]), pose[None])
    )
    mask = tracks_mask((track,), CAMERA, np.eye(4), 0)
    outline = box_outline(box_corners(pose, track.size), K)
    area = 0.5 * abs(
        np.dot(outline[:, 0], np.roll(outline[:, 1], 1))
        - np.dot(outline[:, 1], np.roll(outline[:, 0], 1))
    )
    assert mask.sum() == pytest.approx(area, rel=0.02)


def test_what_stands_still_does_not_move():
    log = painted_log()
    assert [t.object_id for t in moving_tracks(log)] == ["other_1"]
    assert moving_tracks(painted_log(frames=2)) == ()
