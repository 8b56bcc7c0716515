"""Progress and rate of a training run."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

from .losses import psnr_of

SMOOTHING = 0.98
"""Fraction of the past in the running loss and PSNR."""


@dataclass(frozen=True)
class TrainingProgress:
    """How far a training run is.

    Attributes:
        iteration, iterations: steps done and in all.
        rate: steps per second of late.
        loss, psnr: smoothed over training images; PSNR in [dB].
        gaussians: at the moment.
        eta_s: seconds that are left at this rate.
    """

    iteration: int
    iterations: int
    rate: float
    loss: float
    psnr: float
    gaussians: int
    eta_s: float


OnTraining = Callable[[TrainingProgress], None]


@dataclass
class RunningMeans:
    """Smoothed figures and the time spent by stage [s]."""

    loss: float = 0.0
    squared: float = 0.0
    weight: float = 0.0
    stages: dict[str, float] = field(default_factory=dict)

    def add(self, loss: float, squared: float) -> None:
        """Take in one step."""
        self.loss = SMOOTHING * self.loss + (1 - SMOOTHING) * loss
        self.squared = SMOOTHING * self.squared + (1 - SMOOTHING) * squared
        self.weight = SMOOTHING * self.weight + (1 - SMOOTHING)

    @property
    def mean_loss(self) -> float:
        """Smoothed loss."""
        return self.loss / max(self.weight, 1e-9)

    @property
    def psnr(self) -> float:
        """Of the smoothed squared error [dB]."""
        return psnr_of(self.squared / max(self.weight, 1e-9))


class RateMeter:
    """Steps per second since the last call."""

    def __init__(self, iteration: int) -> None:
        self._iteration, self._time = iteration, time.perf_counter()

    def rate(self, iteration: int) -> float:
        """Of the steps up to ``iteration``."""
        now = time.perf_counter()
        rate = max(iteration - self._iteration, 1) / max(now - self._time, 1e-6)
        self._iteration, self._time = iteration, now
        return rate


class StepTimer:
    """Adds the seconds of a block to a stage."""

    def __init__(self, stages: dict[str, float]) -> None:
        self._stages = stages

    def __call__(self, name: str) -> StepTimer:
        """For ``with``: the block's seconds count as those of ``name``."""
        self._name = name
        return self

    def __enter__(self) -> None:
        self._start = time.perf_counter()

    def __exit__(self, *_: object) -> None:
        spent = time.perf_counter() - self._start
        self._stages[self._name] = self._stages.get(self._name, 0.0) + spent
