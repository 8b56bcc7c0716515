"""Versioned scores of episodes: the same code for a running episode and for a recording."""

from .formulas import VERSIONS, Score, metrics_version, running, scores_of
from .instant import (
    ContactNote,
    EgoSample,
    Instant,
    Others,
    ScoringContext,
)
from .tally import Tally, after, begin

__all__ = [
    "VERSIONS",
    "ContactNote",
    "EgoSample",
    "Instant",
    "Others",
    "Score",
    "ScoringContext",
    "Tally",
    "after",
    "begin",
    "metrics_version",
    "running",
    "scores_of",
]
