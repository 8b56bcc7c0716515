"""The family of metrics: each a function of the accumulator, registered under name and version."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, NamedTuple

from .accumulator import MetricAccumulator
from .blind_spots import Aspect, cannot_see
from .instant import Instant, ScoringContext

NO_TERMS: Mapping[str, float] = MappingProxyType({})


class Score(NamedTuple):
    """One score; the fields of the wire's Score."""

    name: str
    version: str
    value: float | None
    terms: dict[str, float]
    assumed: tuple[str, ...]
    missing: tuple[str, ...]
    cannot_see: str = ""

    def fields(self) -> dict[str, Any]:
        """As a plain map."""
        return {
            "name": self.name,
            "version": self.version,
            "value": self.value,
            "terms": dict(self.terms),
            "assumed": list(self.assumed),
            "missing": list(self.missing),
            "cannot_see": self.cannot_see,
        }


class MetricValue(NamedTuple):
    """What a metric is worth.

    Attributes:
        value: None where ``missing`` says what it would take.
        terms: that it is made of, by name.
        assumed: what is taken for granted.
        missing: what is not known.
    """

    value: float | None
    terms: Mapping[str, float] = NO_TERMS
    assumed: tuple[str, ...] = ()
    missing: tuple[str, ...] = ()


Formula = Callable[[MetricAccumulator, ScoringContext], MetricValue]
Running = Callable[[MetricAccumulator, ScoringContext], float | None]


NO_STEP = "a step that counts"


@dataclass(frozen=True)
class Metric:
    """One member of the family.

    Attributes:
        name: on the wire and in recordings.
        version: raised when a value may change for the same episode.
        formula: of the accumulator; must not depend on anything else.
        running: the value of the formula alone, without what it is made of: it is part of every
            observation; None for a metric that is not.
        begin, update: where the accumulator lacks something: ``begin(instant, context)`` makes
            state of the metric's own where the scores begin, ``update(state, instant, context)`` a
            new state one step later; ``accumulator.states[name]`` has it. Both or neither.
        sees: what it looks at beside contact, for the sentence that says what it cannot see; None
            leaves that out.
    """

    name: str
    version: str
    formula: Formula
    running: Running | None = None
    begin: Callable[[Instant, ScoringContext], Any] | None = None
    update: Callable[[Any, Instant, ScoringContext], Any] | None = None
    sees: frozenset[Aspect] | None = None

    @property
    def streamed(self) -> bool:
        """Whether its value is part of every observation."""
        return self.running is not None

    def score(self, accumulator: MetricAccumulator, context: ScoringContext) -> Score:
        """The score of an episode so far."""
        found = self.formula(accumulator, context)
        if not accumulator.steps:
            # Nothing was driven that any formula could be about.
            found = MetricValue(None, {}, missing=(NO_STEP,))
        blind = "" if self.sees is None else cannot_see(self.sees, accumulator, context)
        return Score(
            self.name,
            self.version,
            found.value,
            dict(found.terms),
            found.assumed,
            found.missing,
            blind,
        )


METRICS: dict[str, Metric] = {}
"""All metrics by name, in the order in which they are reported."""


def metric(
    name: str,
    *,
    version: str,
    streamed: bool = False,
    running: Running | None = None,
    begin: Callable[[Instant, ScoringContext], Any] | None = None,
    update: Callable[[Any, Instant, ScoringContext], Any] | None = None,
    sees: Iterable[Aspect] | None = None,
) -> Callable[[Formula], Formula]:
    """Register a formula as a metric; see :class:`Metric` for the arguments, of which ``streamed``
    stands for a ``running`` that is the value of the formula.

    Raises:
        ValueError: the name is taken, or only one of ``begin`` and ``update`` is given.
    """
    if (begin is None) != (update is None):
        raise ValueError(f"metric {name!r} needs both begin and update, or neither")

    def register(formula: Formula) -> Formula:
        if name in METRICS:
            raise ValueError(f"there is a metric {name!r} already")
        seen = None if sees is None else frozenset(sees)
        value = _value_of(formula) if streamed and running is None else running
        METRICS[name] = Metric(name, version, formula, value, begin, update, seen)
        return formula

    return register


def _value_of(formula: Formula) -> Running:
    return lambda accumulator, context: formula(accumulator, context).value


def scores_of(accumulator: MetricAccumulator, context: ScoringContext) -> list[Score]:
    """All scores of an episode so far."""
    return [m.score(accumulator, context) for m in METRICS.values()]


def metric_versions() -> dict[str, str]:
    """Version of each metric by its name."""
    return {m.name: m.version for m in METRICS.values()}


def metrics_version() -> str:
    """Versions of all metrics in one string; published to clients and in recordings."""
    return " ".join(f"{name}@{version}" for name, version in metric_versions().items())
