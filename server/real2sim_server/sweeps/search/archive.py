"""An archive of failures that differ: the worst of each cell (MAP-Elites, Mouret, Clune 2015)."""

from __future__ import annotations

from dataclasses import dataclass, field

from .evaluation import Cell, Evaluation


@dataclass
class Archive:
    """Cells, each with its elite.

    Attributes:
        elites: avoidable failures with the highest score, by cell.
        first: number of the evaluation that found the first one, from 1; None while there is none.
    """

    elites: dict[Cell, Evaluation] = field(default_factory=dict)
    first: int | None = None

    def add(self, found: Evaluation, number: int) -> bool:
        """Whether it is kept: a failure in a new cell, or worse than the one there."""
        if not found.is_failure or found.cell is None:
            return False
        self.first = number if self.first is None else self.first
        there = self.elites.get(found.cell)
        if there is not None and there.score >= found.score:
            return False
        self.elites[found.cell] = found
        return True

    def ordered(self) -> list[Evaluation]:
        """Elites, the worst first."""
        return sorted(self.elites.values(), key=lambda e: (-e.score, e.cell or ()))
