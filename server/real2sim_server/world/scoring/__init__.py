"""Versioned scores of episodes: the same code for a running episode and for a recording."""

from .accumulator import MetricAccumulator, begin_accumulator, update_accumulator
from .instant import ContactRecord, EgoSample, Instant, ObjectSamples, ScoringContext
from .metrics import VERSIONS, Score, metrics_version, running_metrics, scores_of

__all__ = [
    "VERSIONS",
    "ContactRecord",
    "EgoSample",
    "Instant",
    "MetricAccumulator",
    "ObjectSamples",
    "Score",
    "ScoringContext",
    "begin_accumulator",
    "metrics_version",
    "running_metrics",
    "scores_of",
    "update_accumulator",
]
