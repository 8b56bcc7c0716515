"""The learn bench on a minimal workload."""

from __future__ import annotations

from dataclasses import replace

import pytest

from real2sim_bench import learn
from real2sim_server.demo.street import SHIPPED
from real2sim_server.scene.io import read_packed

OPTIONS = learn.LearnBenchOptions(
    worlds=2, steps=2, image_steps=1, repetitions=1, sessions=2, socket_steps=2, echo=False
)


@pytest.mark.parametrize("part", ["small_images", "batched_worlds", "vector_environment"])
def test_single_process_figures_are_positive(part: str) -> None:
    figures = learn.PARTS[part](read_packed(SHIPPED), OPTIONS)
    flat = [v for value in figures.values() for v in _values(value)]
    assert flat
    assert all(v > 0 for v in flat)


def test_small_image_mode_does_not_lose_quality() -> None:
    figures = learn.small_images(read_packed(SHIPPED), OPTIONS)
    assert figures["psnr_db"] > figures["full_psnr_db"] - 1.5
    assert figures["worst_gain_db"] > -1.5


@pytest.mark.network
@pytest.mark.slow
def test_sessions_over_sockets_are_measured() -> None:
    figures = learn.sessions_over_sockets(read_packed(SHIPPED), OPTIONS)
    assert figures["steps_per_s"] > 0
    assert figures["sessions"] == 2


@pytest.mark.slow
@pytest.mark.network
def test_sessions_on_two_workers_are_measured() -> None:
    options = replace(OPTIONS, echo=True)
    figures = learn.sessions_of_two_workers(read_packed(SHIPPED), options)
    assert figures["steps_per_s"] > 0
    assert figures["sessions"] == 2
    assert figures["of_echoed_messages"] == pytest.approx(
        figures["steps_per_s"] / figures["echoed_messages_per_s"]
    )


def _values(value: object) -> list[float]:
    if isinstance(value, dict):
        return [v for part in value.values() for v in _values(part)]
    return [float(value)]  # type: ignore[arg-type]
