"""The figures of a bench as a table for people."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.console import Console
from rich.table import Table

TITLES = {
    "no_sensors": "drive step, no sensors",
    "no_sensors_sdk": "the same, in the SDK",
    "one_raw_camera": "drive step, one raw camera",
}


def print_report(console: Console, figures: Mapping[str, Any]) -> None:
    """Print latencies, stages, lag of the event loop and memory."""
    console.print(_latencies(figures))
    console.print(_stages(figures))
    lag, memory = figures["event_loop"], figures["memory"]
    share, bound = lag["own_share_within_5_ms"], lag["own_p99_below_ms"]
    console.print(
        f"event loop under load: {share:.1%} of {lag['own_samples']} samples within 5 ms, "
        f"p99 below {bound:g} ms; one heavy picture takes {lag['heavy_picture_ms']:.0f} ms"
    )
    if memory:
        console.print(
            f"memory: {memory['per_session_mb']:.2f} MB for each of {memory['sessions']} sessions"
        )


def _latencies(figures: Mapping[str, Any]) -> Table:
    table = Table("[ms]", "p50", "p95", "p99", "max", "n", title="latency", title_justify="left")
    rows = {title: figures[name] for name, title in TITLES.items()}
    lag = figures["event_loop"]
    rows["ping, worker idle"] = lag["ping_idle_ms"]
    rows["ping, worker drawing"] = lag["ping_loaded_ms"]
    for title, row in rows.items():
        numbers = [f"{row[name]:.2f}" for name in ("p50", "p95", "p99", "max")]
        table.add_row(title, *numbers, str(row["count"]))
    return table


def _stages(figures: Mapping[str, Any]) -> Table:
    camera = figures["one_raw_camera"]
    table = Table("stage", "p50 [ms]", title=TITLES["one_raw_camera"], title_justify="left")
    for stage, milliseconds in camera["p50_by_stage_ms"].items():
        table.add_row(stage, f"{milliseconds:.2f}")
    table.add_row("share that is not render", f"{camera['share_not_render']:.1%}")
    return table
