"""The family of drivers: what ``agents.drivers`` of a reset names.

A driver is a class that satisfies :class:`.driver.AgentDriver`; a new one is a module with it and a
line of :data:`DRIVERS`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from real2sim_proto.episode import AgentDriver as DriverSpec
from real2sim_proto.episode import (
    ConstantVelocityDriver,
    CutInDriver,
    ExternalDriver,
    HardBrakeDriver,
    IdmDriver,
    JunctionCrossingDriver,
    LaneDriver,
    ReplayDriver,
)

from ...edit import ObjectState
from .adversarial import CutIn, HardBrake, JunctionCrossing
from .driver import AgentDriver, Surroundings
from .external import External
from .idm import Idm
from .lane_changer import LaneChanger
from .replay import ConstantVelocity, Replay

BeginDriver = Callable[[ObjectState, Any, Surroundings], AgentDriver]
"""``begin(subject, spec, surroundings)``: the driver of an object from the instant on that the
surroundings are of; ``spec`` is of the type that it is registered for."""

DRIVERS: dict[type[Any], BeginDriver] = {
    ReplayDriver: Replay.begin,
    ConstantVelocityDriver: ConstantVelocity.begin,
    IdmDriver: Idm.begin,
    LaneDriver: LaneChanger.begin,
    CutInDriver: CutIn.begin,
    HardBrakeDriver: HardBrake.begin,
    JunctionCrossingDriver: JunctionCrossing.begin,
    ExternalDriver: External.begin,
}
"""By the model of the wire that names the driver and holds its parameters."""


def begin_driver(subject: ObjectState, spec: DriverSpec, surroundings: Surroundings) -> AgentDriver:
    """The driver that a spec names, beginning at the instant of ``surroundings``."""
    return DRIVERS[type(spec)](subject, spec, surroundings)
