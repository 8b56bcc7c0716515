"""Versioned scores of episodes: the same code for a running episode and for a recording."""

from .accumulator import MetricAccumulator, after, begin
from .instant import ContactNote, EgoSample, Instant, Others, ScoringContext
from .metrics import VERSIONS, Score, metrics_version, running, scores_of

__all__ = [
    "VERSIONS",
    "ContactNote",
    "EgoSample",
    "Instant",
    "MetricAccumulator",
    "Others",
    "Score",
    "ScoringContext",
    "after",
    "begin",
    "metrics_version",
    "running",
    "scores_of",
]
