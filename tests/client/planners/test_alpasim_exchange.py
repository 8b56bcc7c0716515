"""Replays a recorded drive by NVIDIA's own driver service.

``alpasim_exchange.json`` holds the answers of the service, call by call, and their origin. If
REAL2SIM_ALPASIM names a checkout, ``tests/server/service/sessions/test_alpasim_driver.py`` drives
with the service itself.
"""

from __future__ import annotations

import dataclasses
import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import grpc
import pytest

from real2sim._alpasim import DRIVER, DRIVER_METHODS
from real2sim.planners.alpasim import AlpasimDriver
from tests.waiting import LIMIT_S

from . import rig

pytestmark = pytest.mark.network

EXCHANGE = json.loads(Path(__file__).with_name("alpasim_exchange.json").read_text())


@pytest.fixture
def service():
    """Serves recorded answers, and refuses calls in a different order."""
    left = list(EXCHANGE["calls"])

    def handler(name: str):
        def handle(_request: bytes, context) -> bytes:
            call = left.pop(0) if left else {"method": "nothing more"}
            if call["method"] != name:
                context.abort(grpc.StatusCode.ABORTED, f"{name}, not {call['method']}, is called")
            if call.get("status"):
                context.abort(grpc.StatusCode[call["status"]], call["details"])
            return bytes.fromhex(call["answer"])

        return grpc.unary_unary_rpc_method_handler(handle)

    server = grpc.server(ThreadPoolExecutor(1))
    handlers = {name: handler(name) for name in DRIVER_METHODS}
    server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler(DRIVER, handlers),))
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    yield f"127.0.0.1:{port}", left
    server.stop(None).wait()


def observations(count: int):
    """A vehicle at 6 m/s, observed at 10 Hz."""
    for k in range(count):
        t_us = 1_000_000 + 100_000 * k
        seen = rig.seen(position=(100.0 + 0.6 * k, 50.0, 2.0), yaw=0.0)
        frames = {
            name: {"rgb": dataclasses.replace(found["rgb"], t_us=t_us)}
            for name, found in seen.frames.items()
        }
        yield dataclasses.replace(seen, t_us=t_us, frames=frames)


def drive(target: str):
    planner = AlpasimDriver(target, timeout=LIMIT_S)
    first, *_ = seen = list(observations(6))
    planner.reset(first)
    plans = [planner.plan(obs) for obs in seen]
    planner.close()
    return plans


def test_the_recorded_service_drives(service):
    target, left = service
    plans = drive(target)
    assert not left
    # The context is four images from each of two cameras. Then it drives straight at 6 m/s.
    assert [plan.frame for plan in plans] == ["vehicle"] * 3 + ["world"] * 3
    for k, plan in enumerate(plans[3:], start=3):
        now = 1_000_000 + 100_000 * k
        assert plan.times_us == [now + 100_000 * (i + 1) for i in range(20)]
        xs = [pose[0] for pose in plan.poses]
        assert xs == pytest.approx([100.0 + 0.6 * (k + i + 1) for i in range(20)], abs=1e-3)
