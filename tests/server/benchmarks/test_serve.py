"""The serve bench measures a worker that it starts, and prints the results."""

from __future__ import annotations

import json

import pytest

from real2sim_bench import serve
from real2sim_bench.serve import _quantile_bound

pytestmark = pytest.mark.network


def test_percentiles_of_values():
    figures = serve.percentiles([float(v) for v in range(101)])
    assert figures == {"count": 101, "min": 0, "p50": 50, "p95": 95, "p99": 99, "max": 100}


def test_a_histogram_quantile_is_the_upper_bound_of_its_bucket():
    buckets = {"0.001": 90.0, "0.005": 98.0, "0.01": 100.0, "+Inf": 100.0}
    assert _quantile_bound(buckets, 0.9) == 1.0
    assert _quantile_bound(buckets, 0.99) == 10.0
    assert _quantile_bound({}, 0.99) is None


def test_pauses_of_a_process_are_recorded(monkeypatch):
    readings = iter([0.0, 0.0005, 0.0105, 0.0110, 0.0260, 1.0])
    monkeypatch.setattr(serve.time, "perf_counter", lambda: next(readings))
    assert serve._read_the_clock(0.02) == pytest.approx([0.01, 0.015])


@pytest.mark.slow
def test_pauses_are_summarized_over_all_cores():
    figures = serve.pauses(0.05)
    assert figures["cores"] >= 1
    assert figures["longest_ms"] == 0 or figures["longest_ms"] > 1
    assert (figures["per_second"] > 0) == (figures["longest_ms"] > 0)


def test_steps_without_sensors_have_no_render_stage():
    parts = serve._parts([1.0, 2.0], [{"world": 0.25}, {"world": 0.5, "encode": 0.5}])
    assert parts["share_not_render"] == 1
    assert parts["p50_by_stage_ms"] == {"world": 0.375, "encode": 0.25, "socket and rest": 0.875}


@pytest.mark.slow
def test_a_short_run_reports_all_figures_as_json(capsys):
    options = serve.ServeBenchOptions(
        gaussians=100_000,
        steps=50,
        camera_steps=5,
        heavy_seconds=1.0,
        real_time_steps=3,
        pause_seconds=0.2,
    )
    figures = serve.run(options)
    assert json.loads(json.dumps(figures)) == figures
    assert figures["no_sensors"]["count"] == 50
    assert figures["one_raw_camera"]["p50_by_stage_ms"]["render"] > 0
    assert 0 < figures["one_raw_camera"]["share_not_render"] < 1
    assert figures["real_time"]["cameras"] == [[480, 320]] * 3
    overhead = figures["real_time"]["overhead_ms"]
    assert 0 < overhead["p50"] < figures["real_time"]["p50"]
    crowded = figures["crowded"]
    assert crowded["count"] == crowded["alone"]["count"] == 5
    assert figures["memory"]["per_session_mb"] < 5
    assert figures["machine"]["cores"] >= 1
    assert "drive step, no sensors" in capsys.readouterr().out
