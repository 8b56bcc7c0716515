from __future__ import annotations

import numpy as np
import pytest

from real2sim_server.geometry import box_corners
from real2sim_server.logs import ObjectTrack
from real2sim_server.reconstruct.logged_view import (
    below_horizon,
    box_outline,
    moving_tracks,
    tracks_mask,
)
from real2sim_server.scene import Camera, Trajectory

from .conftest import painted_log

K = np.array([[100.0, 0, 60], [0, 100, 40], [0, 0, 1]])
CAMERA = Camera("front", 120, 80, K, np.eye(4))


def box(centre, size) -> ObjectTrack:
    pose = np.eye(4)
    pose[:3, 3] = centre
    times = np.array([0, 1000])
    return ObjectTrack("box_0", "box", size, Trajectory.from_transforms(times, [pose, pose]))


def test_a_box_seen_frontally_covers_its_near_face():
    # Box aligned with the camera: 2 m wide, 1 m high, front face at 9.5 m; 1 m is 100 / 9.5 px.
    mask = tracks_mask((box((0, 0, 10), (2.0, 1.0, 1.0)),), CAMERA, np.eye(4), 0)
    rows, columns = np.nonzero(mask)
    half = 100 / 9.5
    assert (columns.min(), columns.max() + 1) == (round(60 - half), round(60 + half))
    assert (rows.min(), rows.max() + 1) == (round(40 - half / 2), round(40 + half / 2))
    assert mask.sum() == (np.ptp(columns) + 1) * (np.ptp(rows) + 1)


def test_a_box_behind_the_camera_covers_nothing():
    assert not tracks_mask((box((0, 0, -10), (2.0, 1.0, 1.0)),), CAMERA, np.eye(4), 0).any()


def test_a_box_across_the_image_plane_is_clipped():
    # The box extends from 5 m behind to 5 m ahead, on the right: only the right half shows it.
    mask = tracks_mask((box((2, 0, 0), (2.0, 1.0, 10.0)),), CAMERA, np.eye(4), 0)
    assert mask.any()
    assert not mask[:, :60].any()
    # The mask starts at the far inner edge, 1 m to the right at 5 m.
    assert np.nonzero(mask.any(axis=0))[0].min() == 80


def test_a_track_is_masked_only_during_its_lifetime():
    track = box((0, 0, 10), (2.0, 1.0, 1.0))
    assert tracks_mask((track,), CAMERA, np.eye(4), 30_000).any()
    assert not tracks_mask((track,), CAMERA, np.eye(4), 300_000).any()


def test_the_mask_of_a_rotated_box_has_the_area_of_its_outline():
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


def test_only_moving_tracks_are_selected():
    log = painted_log()
    assert [t.object_id for t in moving_tracks(log)] == ["other_1"]
    assert moving_tracks(painted_log(frames=2)) == ()


def test_pixels_below_the_horizon_of_a_level_camera():
    log = painted_log(frames=2)
    camera = log.rig.cameras[0]
    below = below_horizon(log, camera, 0)
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    x, y = (u - camera.K[0, 2]) / camera.K[0, 0], (v - camera.K[1, 2]) / camera.K[1, 1]
    assert (below == (y > np.tan(np.radians(1)) * np.hypot(x, 1))).all()
