"""What impacts break and fold of a vehicle in the closed loop, followed through their frames."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from ...geometry.rotation import Float
from ...scene import GaussianCloud
from ...simulation import impact as crash
from ...simulation.breakage import Breakage, BreakageLog, Part
from ...simulation.damage import HANGS_STILL, DamagedVehicle
from .impact import Impact

HARD = 5.0
"""Fragments fly as far as they do from a limit passed once, per so much approach speed [m/s]."""


@dataclass(frozen=True, eq=False)
class VehicleDamage:
    """What impacts have done to a vehicle until an instant.

    Attributes:
        most: [G, 3] largest shortening so far.
        broken: parts that broke.
    """

    most: Float
    broken: tuple[Breakage, ...] = ()

    def hanging(self, t_us: int) -> int:
        """The instant at which what hangs loose is drawn [us]: none after it hangs still."""
        fell = [b.time_s for b in self.broken if b.kind == "bumper"]
        if not fell:
            return 0
        return min(t_us, math.ceil((max(fell) + HANGS_STILL) * 1e6))

    def cloud(self, vehicle: DamagedVehicle, displacements: Float, t_us: int) -> GaussianCloud:
        """What is drawn with particles displaced [N, 3] [m]."""
        time_s = t_us * 1e-6
        ages = {b.part: max(time_s - b.time_s, 0.0) for b in self.broken}
        return vehicle.cloud(displacements, self.most, ages)


@dataclass(eq=False)
class DamageHistory:
    """The damage of one impact, frame by frame; asking twice gives the same.

    Attributes:
        object_id: the vehicle.
        vehicle: as it is drawn.
        log: of its parts, as it was before the impact.
        before: what was damaged before.
    """

    object_id: str
    vehicle: DamagedVehicle
    log: BreakageLog
    before: VehicleDamage
    _frames: int = 0
    _now: VehicleDamage | None = None
    _log: BreakageLog | None = field(default=None)

    def after(self, frames: Sequence[Float], impact: Impact, role: int) -> VehicleDamage:
        """The damage after the first frames of an impact, one each ``crash.FRAME_S``.

        Args:
            frames: displacements [N, 3] of the vehicle's particles, from contact on [m].
            impact: in which it was the body ``role``.
        """
        if self._now is None or self._log is None or self._frames > len(frames):
            self._frames, self._now = 0, self.before
            self._log = self.log.copy()
        for k in range(self._frames, len(frames)):
            most = np.maximum(self._now.most, self.vehicle.shortening(frames[k]))
            new = [
                self._breakage(part, self._log.place(part, frames[k]), impact, role, k)
                for part in self._log.follow(frames[k])
            ]
            self._now = VehicleDamage(most, (*self._now.broken, *new))
        self._frames = len(frames)
        return self._now

    def final_log(self) -> BreakageLog:
        """Of the parts after what was asked for last."""
        return self.log if self._log is None else self._log

    def _breakage(
        self, part: Part, place: Float, impact: Impact, role: int, frame: int
    ) -> Breakage:
        """A part that broke in a frame; the pulse says how the vehicle goes on."""
        assert impact.participants is not None
        own = impact.participants[role]
        assert own is not None
        body, age = own.body, (frame + 1) * crash.FRAME_S
        before = np.array([body.vx, body.vy])
        after = before + _pushed(impact, role) / own.properties.mass
        cos, sin = math.cos(body.yaw), math.sin(body.yaw)
        turn = np.array([[cos, -sin], [sin, cos]])
        origin = np.array([body.x, body.y]) + own.properties.box_ahead * turn[:, 0]
        at = origin + (before + after) / 2 * age + turn @ place[:2]
        outward = turn @ np.array(part.outward[:2])
        return Breakage(
            self.object_id,
            part.name,
            part.kind,
            impact.began_us * 1e-6 + age,
            (float(at[0]), float(at[1]), (own.low + own.high) / 2 + float(place[2])),
            (float(after[0]), float(after[1]), 0.0),
            (float(outward[0]), float(outward[1]), part.outward[2]),
            max(impact.approach_speed / HARD, 1.0),
        )


def _pushed(impact: Impact, role: int) -> Float:
    """[2] the whole impulse of an impact on one of its bodies [N s]."""
    exchanged = np.array(impact.impulse)
    strength = float(np.linalg.norm(exchanged))
    if impact.whole is not None and strength > 0:
        exchanged = exchanged * (impact.whole / strength)
    return exchanged if role == 0 else -exchanged
