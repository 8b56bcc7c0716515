"""The whole table at once: ``real2sim validate``."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ..backends import BACKENDS
from ..errors import PhysicsError
from . import CASES, Case
from .check import Check

__all__ = ["CASES", "CaseResult", "as_figures", "run_table"]


@dataclass(frozen=True)
class CaseResult:
    """One case as it went.

    Attributes:
        name: key of CASES.
        about: what it is, one sentence.
        checks: its lines; none when it broke off.
        error: why it broke off, or empty.
        seconds: it took.
    """

    name: str
    about: str
    checks: tuple[Check, ...]
    error: str
    seconds: float

    @property
    def passed(self) -> bool:
        """Whether it came to its end and every line holds."""
        return not self.error and all(check.passed for check in self.checks)


def run_table(
    *,
    backend: str = "cpu",
    cases: Sequence[str] | None = None,
    available: Mapping[str, Case] | None = None,
    on_progress: Callable[[int, int], None] | None = None,
) -> list[CaseResult]:
    """Run the cases of those names, or all, and hold them to theory.

    Args:
        backend: of the solver.
        cases: names; all of CASES when not given.
        available: what names may stand for; CASES when not given.
        on_progress: takes (cases done, cases).

    Raises:
        PhysicsError: for names there are not.
    """
    if backend not in BACKENDS:
        raise PhysicsError(f"unknown backend {backend!r}; allowed are {list(BACKENDS)}")
    available = CASES if available is None else available
    names = list(CASES) if cases is None else list(cases)
    unknown = sorted(set(names) - set(available))
    if unknown or not names:
        raise PhysicsError(f"no cases {unknown}; there are {', '.join(available)}")
    results = []
    for done, name in enumerate(names):
        if on_progress:
            on_progress(done, len(names))
        results.append(_run_case(name, available[name], backend))
    if on_progress:
        on_progress(len(names), len(names))
    return results


def as_figures(results: Sequence[CaseResult], backend: str) -> dict[str, Any]:
    """The results as JSON takes them."""
    return {
        "backend": backend,
        "passed": all(r.passed for r in results),
        "lines": [
            {
                "case": r.name,
                "name": c.name,
                "measured": c.measured,
                "expected": c.expected,
                "tolerance": c.tolerance,
                "unit": c.unit,
                "passed": c.passed,
            }
            for r in results
            for c in r.checks
        ],
        "cases": [
            {"name": r.name, "passed": r.passed, "error": r.error, "seconds": round(r.seconds, 3)}
            for r in results
        ],
    }


def _run_case(name: str, case: Case, backend: str) -> CaseResult:
    about = (case.__doc__ or "").strip().split("\n\n")[0]
    about = " ".join(about.split())
    begin = time.perf_counter()
    checks: tuple[Check, ...] = ()
    error = ""
    try:
        checks = tuple(case(backend))
    except (PhysicsError, IndexError, ValueError) as problem:
        # A case that finds no contact or no crossing must fail its line, not the table.
        error = f"{type(problem).__name__}: {problem}"
    return CaseResult(name, about, checks, error, time.perf_counter() - begin)
