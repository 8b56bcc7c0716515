"""The worker refuses damaged requests and messages without affecting other clients.

Each target runs in its own process with a memory limit of 2 GiB. The worker may only give
documented answers, log no errors, and never hang. A session driven during the attack must not be
affected. ``REAL2SIM_FUZZ_INPUTS`` (default 3000 per target) sets the number of inputs and
``REAL2SIM_FUZZ_SEED`` (default 0) the seed.
"""

from __future__ import annotations

import importlib.util
import os
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parent
WAYS = ("routes", "requests", "uploads", "drive", "view", "frames")
"""Targets: calls, raw request bytes, uploads, socket messages, and handshake and frame bytes."""

pytestmark = [pytest.mark.network, pytest.mark.usefixtures("worker_kernels")]


def _check():
    spec = importlib.util.spec_from_file_location("fuzz_check", FOLDER / "check.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_few_damaged_inputs_are_refused_without_side_effects():
    _check().check_service(*WAYS, inputs=8)


@pytest.mark.slow
@pytest.mark.timeout(7200)
@pytest.mark.parametrize("way", WAYS)
def test_many_damaged_inputs_are_refused_without_side_effects(way):
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
