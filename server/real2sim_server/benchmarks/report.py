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
    "real_time": "drive step, demo's street, three raw cameras",
    "crowded": "drive step, one raw camera, beside large renders",
}
BY_STAGE = ("no_sensors", "one_raw_camera", "real_time")


def print_report(console: Console, figures: Mapping[str, Any]) -> None:
    """Print latencies, stages, lag of the event loop, memory and the machine's own pauses."""
    console.print(_latencies(figures))
    for name in BY_STAGE:
        console.print(_stages(TITLES[name], figures[name]))
    lag, memory = figures["event_loop"], figures["memory"]
    share, bound = lag["own_share_within_5_ms"], lag["own_p99_below_ms"]
    console.print(
        f"event loop under load: {share:.1%} of {lag['own_samples']} samples within 5 ms, "
        f"p99 below {bound:g} ms; one heavy picture takes {lag['heavy_picture_ms']:.0f} ms"
    )
    crowded = figures["crowded"]
    console.print(
        f"beside {crowded['pictures']} large renders p99 of a step is "
        f"{crowded['p99_more_ms']:.1f} ms more than alone just before "
        f"({crowded['alone']['p99']:.1f} ms)"
    )
    if memory:
        console.print(
            f"memory: {memory['per_session_mb']:.2f} MB for each of {memory['sessions']} sessions"
        )
    machine = figures["machine"]
    console.print(
        f"machine: a program that only reads the clock, one on each of {machine['cores']} cores, "
        f"is stopped {machine['per_second']:.1f} times a second for more than 1 ms, at most for "
        f"{machine['longest_ms']:.1f} ms"
    )


def _latencies(figures: Mapping[str, Any]) -> Table:
    table = Table(r"\[ms]", "p50", "p95", "p99", "max", "n", title="latency", title_justify="left")
    rows = {title: figures[name] for name, title in TITLES.items()}
    lag = figures["event_loop"]
    rows["ping, worker idle"] = lag["ping_idle_ms"]
    rows["ping, worker drawing"] = lag["ping_loaded_ms"]
    for title, row in rows.items():
        numbers = [f"{row[name]:.2f}" for name in ("p50", "p95", "p99", "max")]
        table.add_row(title, *numbers, str(row["count"]))
    return table


def _stages(title: str, case: Mapping[str, Any]) -> Table:
    table = Table(r"stage \[ms]", "p50", "p95", "p99", title=title, title_justify="left")
    rows = {**case["by_stage_ms"], "all but render and physics": case["overhead_ms"]}
    for stage, row in rows.items():
        table.add_row(stage, *(f"{row[name]:.2f}" for name in ("p50", "p95", "p99")))
    table.add_row("share that is not render", f"{case['share_not_render']:.1%}", "", "")
    if "share_within_100_ms" in case:
        table.add_row("steps within 100 ms", f"{case['share_within_100_ms']:.1%}", "", "")
    return table
