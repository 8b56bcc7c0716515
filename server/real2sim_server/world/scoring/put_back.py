"""The accumulator of an ego that was put back: its places are where the seam takes them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..seam import Seam
from .accumulator import MetricAccumulator
from .comfort import ComfortAccumulator


def put_back(accumulator: MetricAccumulator, seam: Seam) -> MetricAccumulator:
    """The accumulator beyond the seam, so that no step is longer or turns more than it was driven.

    Distances along the route go on and need nothing; the plan before the seam is not compared with
    the next one, for the route bends differently there.
    """
    assert accumulator.ego is not None
    ego, position = accumulator.ego, accumulator.impact_position
    x, y = seam.place(ego.x, ego.y)
    return replace(
        accumulator,
        ego=ego._replace(x=x, y=y, yaw=ego.yaw + seam.turn, path_yaw=ego.path_yaw + seam.turn),
        impact_position=None if position is None else seam.place(*position),
        comfort=_turned(accumulator.comfort, seam),
        comfort_with_history=_turned(accumulator.comfort_with_history, seam),
        plan=None,
    )


def _turned(comfort: ComfortAccumulator, seam: Seam) -> ComfortAccumulator:
    return replace(comfort, samples=comfort.samples + np.array([0.0, seam.turn]))
