"""Elastic bodies that hit each other: discs that swap velocities, a ball on a wall."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from ..body import Body
from ..colliders import Plane
from ..materials import FixedCorotated
from ..particles import Particles, ball_particles, box_particles
from .check import Check, ReferenceCurve, placed, solve

_HERTZ_POWER = 1.5 * 1.07
"""Hertz's indentation is close to sin(pi t)^(1.07), its force to the power 3/2 of that."""


def two_discs(backend: str) -> list[Check]:
    """Sulsky's discs on her 40 x 40 cells, and on half as many (Sulsky et al. 1994).

    They touch when their surfaces do, rebound and part; what is lost shrinks with the cells.
    """
    radius, speed, finest = 0.2, 0.1, 0.025
    fine, first_contact, start = _disc_run(backend, finest)
    coarse, _, _ = _disc_run(backend, 2 * finest)
    exact = (math.hypot(0.6, 0.6) - 2 * radius) / (2 * math.sqrt(2) * speed)
    kept, kept_coarse = fine[0], coarse[0]
    return [
        Check("two discs: kinetic energy at the start, 1 m thick", start, 2.513, 0.02 * 2.513, "J"),
        # Half a cell, as surfaces are that well known, and one check of the contacts.
        Check("two discs: touch", first_contact, exact, 0.5 * finest / (2.83 * speed) + 0.02, "s"),
        Check("two discs: kinetic energy gained", max(kept - 1, 0.0), 0, 1e-9),
        Check("two discs: more is kept on smaller cells", float(kept > kept_coarse), 1, 0),
        Check("two discs: parted", float(fine[1] > 2 * radius), 1, 0),
    ]


def _disc_run(backend: str, dx: float) -> tuple[tuple[float, float], float, float]:
    """((kinetic energy kept, distance at the end), time of contact, initial energy / thickness)."""
    thickness = 0.1
    particles = disc_particles(0.2, thickness, spacing=dx / 2, density=1000)
    material = FixedCorotated(young=1000, poisson=0.3, density=1000)
    bodies = [
        Body(
            name=name,
            particles=particles.moved(placed(0.5 + 0.3 * side, 0.5 + 0.3 * side)),
            material=material,
            velocity=(-0.1 * side, -0.1 * side, 0),
        )
        for name, side in (("left", -1), ("right", 1))
    ]
    solver = solve(bodies, backend=backend, dx=dx)
    start = float(solver.measure.kinetic.sum())
    first_contact = math.nan
    while solver.time < 3.5:
        solver.step(0.02)
        if math.isnan(first_contact) and solver.contacts:
            first_contact = solver.time
    m = solver.measure
    centre = m.momentum / m.mass[:, None]
    # Of the discs as wholes: what still rings in them is not lost, but not kept either.
    kept = float((m.mass * (centre**2).sum(1)).sum()) / 2 / start
    apart = float(np.linalg.norm(m.centre[1] - m.centre[0]))
    return (kept, apart), first_contact, start / thickness


def stiff_discs(backend: str) -> list[Check]:
    """Two discs of 1 GPa that meet at 114 m/s swap velocities (Nairn's two-disc example).

    Up to what goes on ringing in them, for they meet at a seventh of the speed of sound.
    """
    diameter, dx = 0.05, 0.0025
    material = FixedCorotated(young=1e9, poisson=0.33, density=1500)
    speed = 0.07 * math.sqrt(material.young / material.density)
    particles = disc_particles(diameter / 2, 2 * dx, spacing=dx / 2, density=1500)
    bodies = [
        Body(
            name=name,
            particles=particles.moved(placed(side * (diameter / 2 + 0.5 * dx))),
            material=material,
            velocity=(-side * speed, 0, 0),
        )
        for name, side in (("left", -1), ("right", 1))
    ]
    solver = solve(bodies, backend=backend, dx=dx)
    solver.step(4e-4)
    v = solver.measure.momentum[:, 0] / solver.measure.mass / speed
    return [
        Check("stiff discs: left goes as right came", float(v[0]), -1, 0.2),
        Check("stiff discs: right goes as left came", float(v[1]), 1, 0.2),
        Check("stiff discs: momentum", float(v.sum()), 0, 1e-9),
    ]


def hertz(backend: str) -> list[Check]:
    """A ball on a rigid wall: t_c = 2.87 (m^2 / (R E*^2 v))^(1/5) (Johnson 1985, 11.24)."""
    material = FixedCorotated(young=1e6, poisson=0.3, density=1000)
    radius, speed, dx = 0.5, 0.5, 0.05
    particles = ball_particles(radius, spacing=dx / 2, density=1000)
    body = Body(
        name="ball",
        particles=particles.moved(placed(0, 0, radius + 0.1 * dx)),
        material=material,
        velocity=(0, 0, -speed),
    )
    solver = solve([body], [Plane(name="wall", friction=0)], backend=backend, dx=dx)
    stiffness = material.young / (1 - material.poisson**2)
    exact = 2.87 * (particles.mass**2 / (radius * stiffness**2 * speed)) ** 0.2
    times, impulses = [0.0], [0.0]
    while solver.time < 1.4 * exact:
        solver.step(exact / 40)
        times.append(solver.time)
        impulses.append(float(solver.contacts[0].impulse[2]) if solver.contacts else 0.0)
    J = np.array(impulses) / impulses[-1]
    # The force law is symmetric: the middle 98 % of the impulse take 0.85 of the contact.
    inner = float(np.interp(0.99, J, times) - np.interp(0.01, J, times))
    force = np.diff(impulses).max() / (exact / 40)
    depth = (15 * particles.mass * speed**2 / (16 * math.sqrt(radius) * stiffness)) ** 0.4
    peak = 4 / 3 * stiffness * math.sqrt(radius) * depth**1.5
    fraction = _hertz_fraction(0.01)
    t = np.array(times[1:])
    middle = float(np.interp(0.5, J, times))
    phase = np.clip((t - middle) / exact + 0.5, 0, 1)
    curve = ReferenceCurve(
        t.tolist(),
        (np.diff(impulses) / np.diff(times)).tolist(),
        (peak * np.sin(np.pi * phase) ** _HERTZ_POWER).tolist(),
        "time [s]",
        "force of the wall [N]",
    )
    return [
        Check("hertz: contact time", inner / fraction, exact, 0.1 * exact, "s"),
        Check("hertz: peak force", float(force), peak, 0.15 * peak, "N", curve),
    ]


def _hertz_fraction(tail: float) -> float:
    """Fraction of the contact time in which all but ``tail`` at each end of the impulse passes."""
    t = np.linspace(0, 1, 2001)
    J = np.cumsum(np.sin(np.pi * t) ** _HERTZ_POWER)
    J /= J[-1]
    return float(np.interp(1 - tail, J, t) - np.interp(tail, J, t))


def disc_particles(radius: float, thickness: float, *, spacing: float, density: float) -> Particles:
    """A disc across z, centred on the origin; volumes sum to the disc's."""
    lattice = box_particles([2 * radius, 2 * radius, thickness], spacing=spacing, density=density)
    inside = (lattice.positions[:, :2] ** 2).sum(axis=1) < radius**2
    disc = lattice.take(inside)
    volumes = np.full(len(disc), math.pi * radius**2 * thickness / len(disc))
    return replace(disc, volumes=volumes, masses=density * volumes)
