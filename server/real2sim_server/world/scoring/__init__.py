"""Versioned metrics of episodes: the same code for a running episode and for a recording.

:mod:`.metric` is the family, :mod:`.metrics` its members.
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
