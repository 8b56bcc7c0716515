"""The accumulator of an ego that was put back: its places are where the seam takes them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..seam import Seam
from .accumulator import MetricAccumulator
from .comfort import ComfortAccumulator
from .instant import EgoSample
from .window import RowWindow


def put_back(accumulator: MetricAccumulator, seam: Seam) -> MetricAccumulator:
    """The accumulator beyond the seam, so that no step is longer or turns more than it was driven.

    Distances along the route go on and need nothing; the plan before the seam is not compared with
    the next one, for the route bends differently there.
    """
    assert accumulator.ego is not None
    position, found = accumulator.impact_position, accumulator.feasibility
    samples = found.samples.mapped(lambda sample: (_moved(sample[0], seam), sample[1]))
    return replace(
        accumulator,
        ego=_moved(accumulator.ego, seam),
        impact_position=None if position is None else seam.place(*position),
        comfort=_turned(accumulator.comfort, seam),
        comfort_with_history=_turned(accumulator.comfort_with_history, seam),
        feasibility=replace(found, samples=samples),
        plan=None,
    )


def _moved(ego: EgoSample, seam: Seam) -> EgoSample:
    x, y = seam.place(ego.x, ego.y)
    return ego._replace(x=x, y=y, yaw=ego.yaw + seam.turn, path_yaw=ego.path_yaw + seam.turn)


def _turned(comfort: ComfortAccumulator, seam: Seam) -> ComfortAccumulator:
    return replace(comfort, window=RowWindow(comfort.samples + np.array([0.0, seam.turn])))
