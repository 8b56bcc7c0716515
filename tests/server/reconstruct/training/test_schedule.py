from __future__ import annotations

import json
from dataclasses import asdict

from real2sim_server.reconstruct.training import TrainOptions
from real2sim_server.reconstruct.training.schedule import at_width, from_values, preset


def widths(options: TrainOptions, width: int, *fractions: float) -> list[set[int]]:
    """Image widths of three steps after each fraction of the iterations."""
    found = []
    for fraction in fractions:
        first = round(fraction * options.iterations)
        found.append({width // options.divisor(i) for i in range(first, first + 3)})
    return found


def test_wider_images_come_last_and_alternate_with_smaller_ones():
    options = at_width(preset("cpu-small"), 1242)
    assert widths(options, 1242, 0, 0.3, 0.8) == [{310}, {621}, {621, 1242}]
    last = [options.divisor(i) for i in range(3600, 4000)]
    assert 0.3 < last.count(1) / len(last) < 0.36


def test_a_presets_own_width_keeps_its_stages():
    options = at_width(preset("cpu-small"), 621)
    assert widths(options, 621, 0, 0.3, 0.8) == [{310}, {621}, {621}]


def test_options_round_trip_through_json():
    options = at_width(preset("cpu-small"), 1242)
    assert from_values(TrainOptions, json.loads(json.dumps(asdict(options)))) == options
