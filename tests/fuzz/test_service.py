"""Requests and messages that are nearly right: the worker refuses them, and nobody else notices.

Each way in gets inputs under a limit of memory of 2 GiB, in a process of its own: no answer but
those that are announced, nothing in the log, none that keeps the processor busy for good, and a
session beside that goes on as if alone. ``REAL2SIM_FUZZ_INPUTS`` (3000 for each way) and
``REAL2SIM_FUZZ_SEED`` (0) say how many inputs and which.
"""

from __future__ import annotations

import importlib.util
import os
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parent
WAYS = ("routes", "requests", "uploads", "drive", "view", "frames")
"""Damaged calls, damaged bytes of requests, forms with files, messages of the sockets, and bytes
of handshakes and frames."""

pytestmark = [pytest.mark.network, pytest.mark.usefixtures("worker_kernels")]


def _check():
    spec = importlib.util.spec_from_file_location("fuzz_check", FOLDER / "check.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_damaged_requests_and_messages_are_refused_and_nobody_else_notices():
    _check().check_service(*WAYS, inputs=8)


@pytest.mark.slow
@pytest.mark.timeout(7200)
@pytest.mark.parametrize("way", WAYS)
def test_many_damaged_requests_and_messages(way):
    inputs = int(os.environ.get("REAL2SIM_FUZZ_INPUTS", "3000"))
    _check().check_service(way, inputs=inputs)


def test_the_same_seed_gives_the_same_call():
    sys.path.insert(0, str(FOLDER))
    try:
        import random

        import rest

        call = rest.Call("POST", "/v1/scenarios", body=b'{"scene": "tiny"}')
        both = [rest.damaged_call(call, [call], random.Random(3)).data() for _ in range(2)]
    finally:
        sys.path.remove(str(FOLDER))
    assert both[0] == both[1] != call.data()
