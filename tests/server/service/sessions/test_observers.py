"""Observers of a session that another client controls."""

from __future__ import annotations

import numpy as np
import pytest

pytestmark = pytest.mark.network

CAMERA = {"camera": "front"}


def test_observers_receive_every_observation_with_id_0(site, join):
    info = site.create()
    controller = join(info)
    watching = [join(info, "observer") for _ in range(2)]
    sent = [controller.reset(sensors=[CAMERA]), controller.act(0)]
    for observer in watching:
        for expected in sent:
            got = observer.receive()
            assert got["id"] == 0
            np.testing.assert_equal(got | {"id": expected["id"]}, expected)


@pytest.mark.parametrize(
    ("type_", "fields"),
    [
        ("reset", {"spec": {}}),
        ("action", {"step": 0, "plan": {"kind": "control", "acceleration": 0, "steering": 0}}),
        ("edit", {"operations": [{"op": "delete", "object_id": "post"}]}),
    ],
)
def test_observers_cannot_change_the_session(site, join, type_, fields):
    info = site.create()
    controller, observer = join(info), join(info, "observer")
    controller.reset()
    assert observer.receive()["type"] == "obs"
    assert observer.ask(type_, **fields)["code"] == "NOT_CONTROLLER"
    assert controller.act(0)["revision"] == 0


def test_observers_can_render_and_leave(site, join):
    info = site.create()
    controller, observer = join(info), join(info, "observer")
    controller.reset()
    observer.receive()
    assert observer.ask("render", sensors=[CAMERA])["type"] == "view"
    assert observer.ask("bye")["type"] == "result"
    assert observer.wait_closed() == 1000
    assert controller.act(0)["step"] == 1


def test_a_slow_observer_does_not_block_the_controller(site, join):
    info = site.create()
    controller = join(info)
    # A client stops reading from its socket when its queue is full.
    join(info, "observer", max_queue=1)
    controller.reset(sensors=[CAMERA | {"width": 1024, "modalities": ["rgb", "depth"]}], dt_us=1000)
    for step in range(20):
        controller.act(step)
    (queue,) = site.session(info).observers
    assert queue.dropped > 0
