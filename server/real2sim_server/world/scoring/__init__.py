"""Versioned metrics of episodes, for running episodes and recordings alike.

:mod:`.metric` contains the registry, :mod:`.metrics` the metrics.
"""

from .instant import ContactRecord, EgoSample, Instant, ObjectSamples, ScoringContext
from .metric import (
    METRICS,
    Metric,
    MetricAccumulator,
    MetricValue,
    Score,
    begin_accumulator,
    metric,
    metric_versions,
    metrics_version,
    scores_of,
    update_accumulator,
)
from .metrics import running_metrics

__all__ = [
    "METRICS",
    "ContactRecord",
    "EgoSample",
    "Instant",
    "Metric",
    "MetricAccumulator",
    "MetricValue",
    "ObjectSamples",
    "Score",
    "ScoringContext",
    "begin_accumulator",
    "metric",
    "metric_versions",
    "metrics_version",
    "running_metrics",
    "scores_of",
    "update_accumulator",
]
