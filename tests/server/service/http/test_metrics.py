"""Histograms that are updated on the event loop."""

from __future__ import annotations

from prometheus_client import CollectorRegistry, Histogram
from prometheus_client.exposition import generate_latest

from real2sim_server.service.http.telemetry import FAST_BUCKETS, LoopHistogram

SECONDS = (0.0, 0.0005, 0.00051, 0.3, 10.0, 11.0)


def exposed(registry: CollectorRegistry) -> list[str]:
    """All exposed sample lines except the creation time that the library adds."""
    return [
        line for line in generate_latest(registry).decode().splitlines() if "created" not in line
    ]


def test_loop_histograms_are_exposed_like_library_histograms():
    ours, theirs = CollectorRegistry(), CollectorRegistry()
    histogram = LoopHistogram("a_seconds", "text", "stage", buckets=FAST_BUCKETS, registry=ours)
    other = Histogram("a_seconds", "text", ("stage",), buckets=FAST_BUCKETS, registry=theirs)
    for seconds in SECONDS:
        for stage in ("render", "queue"):
            histogram.labels(stage).observe(seconds)
            other.labels(stage).observe(seconds)
    assert exposed(ours) == exposed(theirs)


def test_a_histogram_without_labels_is_exposed_before_any_observation():
    ours, theirs = CollectorRegistry(), CollectorRegistry()
    LoopHistogram("a_seconds", "text", buckets=FAST_BUCKETS, registry=ours).labels()
    Histogram("a_seconds", "text", buckets=FAST_BUCKETS, registry=theirs)
    assert exposed(ours) == exposed(theirs)
