"""The validation table of ``real2sim validate``, and the same table as one HTML page."""

from __future__ import annotations

import io
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np

from ..backends import BACKENDS
from ..errors import PhysicsError
from . import CASES, Case
from .check import Check, ReferenceCurve

__all__ = ["CASES", "CaseResult", "as_figures", "render_page", "run_table"]


@dataclass(frozen=True)
class CaseResult:
    """The result of one case.

    Attributes:
        name: key of CASES.
        about: description in one sentence.
        checks: its checks; empty if it failed with an error.
        error: the error, or empty.
        seconds: run time.
    """

    name: str
    about: str
    checks: tuple[Check, ...]
    error: str
    seconds: float

    @property
    def passed(self) -> bool:
        """Whether it completed and every check passed."""
        return not self.error and all(check.passed for check in self.checks)


def run_table(
    *,
    backend: str = "cpu",
    cases: Sequence[str] | None = None,
    available: Mapping[str, Case] | None = None,
    on_progress: Callable[[int, int], None] | None = None,
) -> list[CaseResult]:
    """Run the named cases, or all, and compare them with theory.

    Args:
        backend: solver backend.
        cases: names of the cases; all by default.
        available: available cases; CASES by default.
        on_progress: called with (cases done, cases).

    Raises:
        PhysicsError: for unknown names.
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
    """The results as JSON values."""
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
        # A case without the expected contact must fail its own row, not the table.
        error = f"{type(problem).__name__}: {problem}"
    return CaseResult(name, about, checks, error, time.perf_counter() - begin)


# The table as a self-contained page.

STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; margin: 2rem auto; max-width: 64rem; color: #20242c; }
h2 { margin: 2rem 0 0; font-size: 1.05rem; } p { margin: .2rem 0 .5rem; color: #57606a; }
table { border-collapse: collapse; width: 100%; }
td, th { padding: .2rem .5rem; text-align: right; border-bottom: 1px solid #d8dee4; }
td:first-child, th:first-child { text-align: left; }
.failed { color: #b3261e; font-weight: 600; } .passed { color: #1a7f37; }
svg { max-width: 100%; height: auto; } figure { margin: .6rem 0; }
"""
MARGIN_WIDTH = 120


def render_page(results: Sequence[CaseResult], *, backend: str) -> str:
    """HTML of the table with its plots inline."""
    lines = [check for r in results for check in r.checks]
    failed = sum(not c.passed for c in lines) + sum(bool(r.error) for r in results)
    verdict = f"{failed} of {len(lines)} lines fail" if failed else f"all {len(lines)} lines hold"
    kind = "failed" if failed else "passed"
    body = "\n".join(_case(r) for r in results)
    return (
        "<!doctype html>\n<html lang='en'><head><meta charset='utf-8'>"
        f"<title>Validation of the solver: {escape(verdict)}</title><style>{STYLE}</style></head>"
        f"<body><h1>Validation of the solver</h1><p>SolverBackend {escape(backend)}: "
        f"<span class='{kind}'>{escape(verdict)}</span>. Margins show the position of a "
        f"measured value within its tolerance.</p>\n{body}\n</body></html>\n"
    )


def _case(result: CaseResult) -> str:
    rows = "".join(_row(check) for check in result.checks)
    error = f"<p class='failed'>{escape(result.error)}</p>" if result.error else ""
    figures = "".join(
        f"<figure>{draw_curve(check.curve, check.name)}</figure>"
        for check in result.checks
        if check.curve
    )
    return (
        f"<h2>{escape(result.name.replace('_', ' '))}</h2><p>{escape(result.about)} "
        f"({result.seconds:.1f} s)</p>{error}<table><tr><th>line</th><th>measured</th>"
        f"<th>expected</th><th>tolerance</th><th>unit</th><th>margin</th><th></th></tr>"
        f"{rows}</table>{figures}"
    )


def _row(check: Check) -> str:
    kind = "passed" if check.passed else "failed"
    return (
        f"<tr><td>{escape(check.name)}</td><td>{check.measured:.5g}</td>"
        f"<td>{check.expected:.5g}</td><td>{check.tolerance:.3g}</td>"
        f"<td>{escape(check.unit)}</td><td>{_margin(check)}</td>"
        f"<td class='{kind}'>{'holds' if check.passed else 'fails'}</td></tr>"
    )


def _margin(check: Check) -> str:
    """A dot between the two ends of the tolerance; at the edge if outside."""
    off = check.measured - check.expected
    error = off / check.tolerance if check.tolerance > 0 else math.copysign(2, off) * (off != 0)
    error = 1.15 if math.isnan(error) else min(max(error, -1.15), 1.15)
    x = MARGIN_WIDTH / 2 * (1 + error / 1.2)
    low, high = (MARGIN_WIDTH / 2 * (1 + s / 1.2) for s in (-1, 1))
    colour = "#1a7f37" if check.passed else "#b3261e"
    return (
        f"<svg width='{MARGIN_WIDTH}' height='14' role='img' aria-label='{error:.2f} tolerances'>"
        f"<line x1='{low:.1f}' x2='{high:.1f}' y1='7' y2='7' stroke='#8b949e'/>"
        f"<line x1='{MARGIN_WIDTH / 2}' x2='{MARGIN_WIDTH / 2}' y1='3' y2='11' stroke='#8b949e'/>"
        f"<circle cx='{x:.1f}' cy='7' r='4' fill='{colour}'/></svg>"
    )


def draw_curve(curve: ReferenceCurve, title: str) -> str:
    """A plot of a curve against theory, as inline SVG."""
    import matplotlib as mpl
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    out = io.StringIO()
    with mpl.rc_context({"svg.hashsalt": title, "svg.fonttype": "none"}):
        figure = Figure(figsize=(7.5, 2.8), layout="constrained")
        axes = figure.add_subplot()
        axes.plot(curve.x, curve.expected, color="#8b949e", lw=2.5, label="theory")
        marker = "o" if len(curve.x) < 30 else None
        axes.plot(curve.x, curve.measured, color="#1f6feb", lw=1.2, marker=marker, label="measured")
        axes.set(xlabel=curve.x_label, ylabel=curve.y_label, title=title)
        axes.grid(alpha=0.3)
        if np.isfinite(curve.measured).any():
            axes.legend()
        nothing = dict.fromkeys(("Date", "Creator", "Format", "Type"))
        FigureCanvasSVG(figure)
        figure.savefig(out, format="svg", metadata=nothing)
    text = out.getvalue()
    return text[text.index("<svg") :]
