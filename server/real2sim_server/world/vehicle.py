"""Constants of the controlled vehicle, derived once from its spec."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

from real2sim_proto.episode import EgoSpec

GRAVITY = 9.81


@dataclass(frozen=True)
class Vehicle:
    """A car as two axles that carry a mass.

    Attributes:
        wheelbase: [m].
        mass: [kg].
        inertia: about the vertical axis through the centre of mass [kg m^2].
        front, rear: distance of each axle from the centre of mass [m].
        height: of the centre of mass [m].
        friction: of tyres on the road.
        front_cornering, rear_cornering: lateral force per load and slip angle [1/rad].
    """

    wheelbase: float
    mass: float
    inertia: float
    front: float
    rear: float
    height: float
    friction: float
    front_cornering: float
    rear_cornering: float

    @property
    def understeer(self) -> float:
        """Understeer gradient [rad s^2/m]: steering angle beyond L/R per lateral acceleration.

        m/L (b/C_f - a/C_r) (Gillespie 1992, eq. 6-15) with stiffnesses in proportion to the
        loads at rest, where the geometry cancels out.
        """
        return (1 / self.front_cornering - 1 / self.rear_cornering) / GRAVITY


@lru_cache(maxsize=256)
def _vehicle(wheelbase: float, figures: tuple[float, ...], inertia: float | None) -> Vehicle:
    mass, share, height, friction, front_cornering, rear_cornering = figures
    front, rear = (1 - share) * wheelbase, share * wheelbase
    return Vehicle(
        wheelbase=wheelbase,
        mass=mass,
        # k^2 / (a b) is close to 1 for passenger cars (Heydinger et al. 1999, SAE 1999-01-1336).
        inertia=inertia if inertia is not None else mass * front * rear,
        front=front,
        rear=rear,
        height=height,
        friction=friction,
        front_cornering=front_cornering,
        rear_cornering=rear_cornering,
    )


def vehicle_of(spec: EgoSpec) -> Vehicle:
    """The constants of a spec."""
    v = spec.vehicle
    figures = (
        v.mass,
        v.front_load,
        v.centre_height,
        v.friction,
        v.front_cornering,
        v.rear_cornering,
    )
    return _vehicle(spec.wheelbase, figures, v.yaw_inertia)
