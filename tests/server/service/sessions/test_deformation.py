"""Images after impacts. Only sessions that need deformation kernels wait for their compilation."""

from __future__ import annotations

import threading

import pytest

from real2sim_server.service import warm_up
from real2sim_server.service.warm_up import DeformationKernels
from real2sim_server.world.collision.deformation import DeformationTracker
from tests.waiting import LIMIT_S

pytestmark = pytest.mark.network

CAMERA = {"camera": "front", "width": 32}


@pytest.fixture
def compiler(site, monkeypatch):
    """Deformation kernels are ready once this event is set. Until then they are being compiled."""
    done = threading.Event()
    monkeypatch.setattr(warm_up, "deformation_on_disk", lambda: True)
    monkeypatch.setattr(warm_up, "warm_up_deformation", lambda: done.wait(LIMIT_S))
    monkeypatch.setattr(site.worker.sessions.pipeline, "_deformation", DeformationKernels())
    yield done
    done.set()


def test_only_a_session_with_an_impact_waits_for_the_kernels(site, join, compiler, monkeypatch):
    hit, other = (join(site.create()) for _ in range(2))
    hit.reset(sensors=[CAMERA], on_collision="continue")
    other.reset(sensors=[CAMERA])
    monkeypatch.setattr(DeformationTracker, "has_impacts", True)
    hit.send("action", step=0, plan={"kind": "control", "acceleration": 0.0, "steering": 0.0})
    for step in range(3):
        assert other.act(step)["step"] == step + 1
    with pytest.raises(TimeoutError):
        hit.socket.recv(timeout=0.1)
    compiler.set()
    moved = hit.receive()
    assert (moved["step"], len(moved["frames"])) == (1, 1)
    assert hit.act(1)["step"] == 2


def test_a_view_after_an_impact_waits_for_the_kernels(site, join, compiler, monkeypatch):
    hit = join(site.create())
    hit.reset(sensors=[], on_collision="continue")
    monkeypatch.setattr(DeformationTracker, "has_impacts", True)
    assert hit.act(0)["step"] == 1  # This step has no images.
    asked = hit.send("render", sensors=[CAMERA])
    with pytest.raises(TimeoutError):
        hit.socket.recv(timeout=0.1)
    compiler.set()
    assert hit.receive()["id"] == asked
