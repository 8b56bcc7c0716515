"""Output of ``bench physics``."""

from __future__ import annotations

import pytest

from real2sim_bench import physics


def figures():
    lines = [
        {
            "name": name,
            "particles": 1000,
            "simulated_s": seconds,
            "elapsed_s": 0.5 * target,
            "processor_s": 0.75 * target,
            "target_s": target,
        }
        for name, (_, seconds, target) in physics.SITUATIONS.items()
    ]
    return {
        "backend": "cpu",
        "threads": 2,
        "speed": [
            {"material": physics.VEHICLE, "particles": 97336, "rate": 8.2e6, "substep_ms": 12.0}
        ],
        "domain": [],
        "crash": {"particles": 11340, "rate": 4.5e6, "substeps": 400},
        "situations": lines,
        "reference": {"ratio": 100.0},
    }


def test_every_situation_is_printed_with_its_target():
    rows = physics.as_rows(figures())
    assert rows["vehicle structure, 97,336 particles"].startswith("8.20 M/s")
    assert rows["two cars at 15 m/s, 2 s"] == "4 s, 6 s of processors; 8 s wanted"
    assert rows["truck and cone, 1 s"].endswith("3 s wanted")
    assert rows["car on a car, 3 s"].endswith("10 s wanted")
    assert rows["a car that rolls, 1 s"] == "10 ms, 15 ms of processors; 20 ms wanted"


@pytest.mark.slow
@pytest.mark.parametrize("name", physics.SITUATIONS)
def test_measured_situations_report_their_cost(name):
    line = physics.measure(name)
    assert line["particles"] > 3000
    assert line["processor_s"] > 0
    assert physics.as_row(line).endswith("wanted")
