"""Images for planners that see, in the process that drives."""

from __future__ import annotations

from dataclasses import replace

import pytest

from real2sim.planners import Needs, load_planner
from real2sim_server.scene import CameraRig, Scene
from real2sim_server.sweeps.episode import CameraFeed, Drive, begin, draw_frames, observation_of


@pytest.fixture(scope="module")
def left_first(tiny_scene) -> Scene:
    """The small street with a rig that names the camera to the left first."""
    rig = CameraRig((tiny_scene.rig["left"], tiny_scene.rig["front"]))
    return replace(tiny_scene, rig=rig)


def test_a_planner_that_names_no_camera_looks_straight_ahead(left_first):
    feed = CameraFeed.of(left_first, Needs(modalities=("rgb",), width=64))
    assert [(c.name, c.width) for c in feed.cameras] == [("front", 64)]


def test_a_planner_that_wants_every_camera_gets_them_in_order(left_first):
    feed = CameraFeed.of(left_first, Needs(modalities=("rgb",), all_cameras=True))
    assert [c.name for c in feed.cameras] == ["left", "front"]


def test_a_blind_planner_is_shown_nothing(left_first):
    assert CameraFeed.of(left_first, Needs()) is None


def test_modalities_that_sweeps_do_not_render_are_named(left_first):
    with pytest.raises(ValueError, match="needs depth; sweeps only render rgb"):
        CameraFeed.of(left_first, Needs(modalities=("depth",)))


def test_worlds_rendered_together_match_single_ones(left_first):
    world = begin(left_first, Drive("idm", {}), Needs(), privileged=False)
    later, planner = world.fork(), load_planner("idm")
    planner.reset(observation_of(later))
    for _ in range(3):
        later.step(planner.plan(observation_of(later)))
    camera = left_first.rig["front"].resized(64)
    together = draw_frames([world, later], camera)
    for frame, alone in zip(together, (world, later), strict=True):
        (expected,) = draw_frames([alone], camera)
        assert (frame.data, frame.t_us) == (expected.data, alone.t_us)
    assert together[0].data != together[1].data
