"""The vehicle preset against published crash figures.

Sources: frontal barrier test of the 2015 Chevrolet Malibu (NHTSA, as in joe-cormier/pycrash):
1651 kg, 56.5 km/h, 10.1 in mean residual crush, restitution 0.013; its load cells give 877 kN/m,
from which follow 0.68 m of dynamic crush, a peak of 37 g and 68 ms to it. Restitution over impact
speed: Cipriani et al. 2002, e = .47477 - .26139 L + .03382 L^2 - .11639 L^3 with
L = log10(v / (m/s)). Mutual stiffness of two cars: 405 +- 139 kN/m (Bonugli et al. 2017); 100 to
150 ms of a rear end. Roof: 127 mm at three times the weight (49 CFR 571.216a). Side against a pole
of 254 mm at 32 km/h (49 CFR 571.214): intrusions of sedans lie around 0.4 m.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from ...physics.validation.check import Check
from .crash_tests import CrashPulse, barrier_test, rear_end, roof_drop, side_crash, side_pole

MALIBU_SPEED = 56.5 / 3.6
MALIBU_CRUSH = 0.2565
MALIBU_DYNAMIC, MALIBU_PEAK, MALIBU_TIME = 0.68, 37.0, 0.068
"""Dynamic crush [m], peak [g] and time to the peak [s]."""
SPEEDS = (1.0, 2.24, 4.47, 8.94)
SPREAD = 0.08
MUTUAL_STIFFNESS = 405e3
ROOF_SPEED = 2.0
"""Slow enough that the roof is pushed in by about what the test of its strength does [m/s]."""
ROOF_DEPTH, ROOF_STRENGTH = 0.127, 3.0


def cipriani(speed: float) -> float:
    """Published mean restitution of cars at an impact speed [m/s]."""
    logarithm = np.log10(speed)
    return float(np.polyval([-0.11639, 0.03382, -0.26139, 0.47477], logarithm))


def malibu(backend: str) -> list[Check]:
    """The barrier test: pulse within 20 %, residual crush within 15 %."""
    return malibu_checks(barrier_test(MALIBU_SPEED, backend))


def malibu_checks(test: CrashPulse) -> list[Check]:
    """A test at the published speed against the published figures."""
    return [
        _within("Malibu dynamic crush", test.dynamic_crush, MALIBU_DYNAMIC, 0.2, "m"),
        _within("Malibu peak deceleration", test.peak, MALIBU_PEAK, 0.2, "g"),
        _within("Malibu time to the peak", test.time_to_peak, MALIBU_TIME, 0.2, "s"),
        _within("Malibu residual crush", test.residual_crush, MALIBU_CRUSH, 0.15, "m"),
        Check("Malibu restitution", test.restitution, 0.013, 0.15),
        Check("largest energy over the first", test.energy_peak, 1.0, 1e-3),
    ]


def restitution_by_speed(backend: str) -> list[Check]:
    """Restitution from walking pace to 32 km/h, as published and falling."""
    tests = [barrier_test(speed, backend, duration=0.5) for speed in SPEEDS]
    checks = [
        Check(f"restitution at {t.speed:.2f} m/s", t.restitution, cipriani(t.speed), SPREAD)
        for t in tests
    ]
    drops = [a.restitution - b.restitution for a, b in pairwise(tests)]
    return [*checks, Check("steps at which it falls", sum(d > 0 for d in drops), len(drops), 0)]


def collinear_pair(backend: str) -> list[Check]:
    """1000 kg into the rear of 2000 kg at 10 m/s: it takes time, and costs both length.

    Delta-v are those of the published restitution, with its spread: not of the one that came out.
    """
    speed, light, heavy = 10.0, 1000.0, 2000.0
    striker, struck = rear_end(speed, backend)
    mass = light * heavy / (light + heavy)
    together = speed * float(np.sqrt(mass / MUTUAL_STIFFNESS))
    crush = striker.dynamic_crush + struck.dynamic_crush
    e = cipriani(speed)
    change, spread = mass * speed * (1 + e), mass * speed * SPREAD
    return [
        Check("rear end: duration", struck.duration, 0.12, 0.04, "s"),
        _within("rear end: crush of both", crush, together, 0.25, "m"),
        Check("rear end: delta-v striker", striker.delta_v, change / light, spread / light, "m/s"),
        Check("rear end: delta-v struck", struck.delta_v, change / heavy, spread / heavy, "m/s"),
        Check("rear end: energy over the first", striker.energy_peak, 1.0, 1e-3),
    ]


def pole(backend: str) -> list[Check]:
    """Sideways into a pole at 32 km/h."""
    test = side_pole(8.9, backend)
    return [
        _within("side pole: intrusion", test.residual_crush, 0.4, 0.25, "m"),
        Check("side pole: energy over the first", test.energy_peak, 1.0, 1e-3),
    ]


def t_bone(backend: str) -> list[Check]:
    """A car into another one's side at 12 m/s: both look it, and share the speed."""
    striker, struck = side_crash(12.0, backend)
    return [
        Check("side: door pushed in", struck.residual_crush, 0.2, 0.1, "m"),
        Check("side: delta-v of the struck", struck.delta_v, 6.5, 0.7, "m/s"),
        Check("side: energy over the first", striker.energy_peak, 1.0, 1e-3),
    ]


def roof(backend: str) -> list[Check]:
    """Fallen on its roof: intrusion by what carries three times the weight at 127 mm."""
    test = roof_drop(ROOF_SPEED, backend)
    return [
        _within("roof: intrusion", test.dynamic_crush, ROOF_DEPTH, 0.25, "m"),
        _within("roof: force in weights", test.peak + 1, ROOF_STRENGTH, 0.25),
    ]


def _within(name: str, measured: float, expected: float, fraction: float, unit: str = "") -> Check:
    return Check(name, measured, expected, fraction * expected, unit)


PUBLISHED = {
    f.__name__: f for f in (malibu, restitution_by_speed, collinear_pair, pole, t_bone, roof)
}
"""Cases by name; ``real2sim validate --cases published`` runs them."""
