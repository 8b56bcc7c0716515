"""Elastic bodies with known answers: waves, bending, stiffness, impacts and Hertz contact."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from ...geometry import Float
from ..body import Body, Particles, ball_particles, box_particles
from ..colliders import Box, Plane
from ..materials import FixedCorotated
from ..solver import Solver
from .check import Check, ReferenceCurve, block, placed, solve


def vibrating_bar(backend: str) -> list[Check]:
    """First mode of a bar, clamped at x = 0: v_cm = 2 v0 / pi cos(omega t).

    L = 25 m, E = 100 Pa, rho = 1 kg/m^3, nu = 0, v = 0.1 sin(pi x / 2L) m/s. The clamp is the
    middle of a bar of twice the length.
    """
    material = FixedCorotated(young=100, poisson=0, density=1)
    still = block(material, size=(50, 2, 2), spacing=0.5)
    x = still.particles.positions[:, 0]
    velocity = np.zeros((len(x), 3))
    velocity[:, 0] = 0.1 * np.sin(np.pi * x / 50)
    gradient = np.zeros((len(x), 3, 3))
    gradient[:, 0, 0] = 0.1 * np.pi / 50 * np.cos(np.pi * x / 50)
    body = block(
        material,
        size=(50, 2, 2),
        spacing=0.5,
        particle_velocities=velocity,
        particle_gradients=gradient,
    )
    solver = solve([body], backend=backend, dx=1.0)
    times, found = [], []
    for _ in range(20):
        solver.step(0.5)
        times.append(solver.time)
        found.append(float(solver.particles().velocities[x > 0, 0].mean()))
    exact = 0.2 / np.pi * np.cos(np.pi * 10 / 50 * np.array(times))
    worst = float(np.abs(found - exact).max()) / (0.2 / np.pi)
    curve = ReferenceCurve(times, found, exact.tolist(), "time [s]", "velocity of the centre [m/s]")
    return [Check("vibrating bar: v_cm over a period", worst, 0, 0.02, curve=curve)]


def bar_on_wall(backend: str) -> list[Check]:
    """A bar on a rigid wall: stress rho c v for 2 L / c, then full rebound."""
    material = FixedCorotated(young=1e6, poisson=0, density=1000)
    length, speed, dx = 2.0, 0.3, 0.05
    c, area = material.wave_speed, 0.1**2
    t, J, rebound = _bar_run(backend, material, (length, 0.1, 0.1), speed, dx)
    _, _, coarse = _bar_run(backend, material, (length, 0.2, 0.2), speed, 2 * dx)
    middle = (t > 0.6 * length / c) & (t < 1.8 * length / c)
    force = float(np.polyfit(t[middle], J[middle], 1)[0])
    stress = material.density * c * speed
    # Impulse over plateau force is the duration of the contact.
    lasted = float(J[-1]) / force
    pushes = np.gradient(J, t) / area
    curve = ReferenceCurve(
        t.tolist(),
        pushes.tolist(),
        np.where(t < 2 * length / c, stress, 0.0).tolist(),
        "time [s]",
        "stress on the wall [Pa]",
    )
    return [
        Check("bar on wall: stress", force / area, stress, 0.03 * stress, "Pa", curve),
        Check("bar on wall: duration", lasted, 2 * length / c, 0.06 * length / c, "s"),
        Check("bar on wall: restitution", rebound, 1.0, 0.08),
        Check("bar on wall: it rises on smaller cells", float(rebound > coarse), 1, 0),
    ]


def _bar_run(
    backend: str,
    material: FixedCorotated,
    size: tuple[float, float, float],
    speed: float,
    dx: float,
) -> tuple[np.ndarray, np.ndarray, float]:
    """Times, impulse of the wall up to each time, and restitution."""
    length, c = size[0], material.wave_speed
    at = (length / 2 + 0.2 * dx, 0, 0)
    body = block(material, size=size, spacing=dx / 2, at=at, velocity=(-speed, 0, 0))
    wall = Plane(name="wall", normal=(1, 0, 0), friction=0)
    solver = solve([body], [wall], backend=backend, dx=dx)
    times, impulses = [], []
    while solver.time < 3.2 * length / c:
        solver.step(0.05 * length / c)
        times.append(solver.time)
        impulses.append(float(solver.contacts[0].impulse[0]) if solver.contacts else 0.0)
    rebound = float(solver.measure.momentum[0, 0] / solver.measure.mass[0]) / speed
    return np.array(times), np.array(impulses), rebound


def confined_compression(backend: str) -> list[Check]:
    """A block in a smooth box under a slow piston: wall pressure over strain inside.

    Mean pressure over volume loss is the bulk modulus; pressure differences give the shear modulus.
    The strain is measured in the middle of the block, because surfaces yield by a fraction of a
    cell.
    """
    material = FixedCorotated(young=1e6, poisson=0.3, density=1000, viscosity=2000)
    edge, speed, window = 0.8, 0.1, 0.04
    body = block(material, size=(edge,) * 3, spacing=0.05)
    middle = np.abs(body.particles.positions).max(axis=1) < edge / 8
    walls = [
        Plane(
            name=f"wall {axis}{side:+d}",
            point=_axis(axis, side * edge / 2),
            normal=_axis(axis, -side),
            friction=0,
        )
        for axis, side in ((0, -1), (0, 1), (1, -1), (1, 1), (2, -1))
    ]
    piston = Box(
        name="piston",
        T_world_box=placed(0, 0, edge),
        size=(4, 4, edge),
        velocity=(0, 0, -speed),
        friction=0,
    )
    solver = solve([body], [*walls, piston], backend=backend)
    solver.step(0.4)
    before = _pushes(solver)
    solver.step(window / 2)
    stretch = solver.particles().F_elastic[middle].mean(axis=0).diagonal()
    solver.step(window / 2)
    force = (_pushes(solver) - before) / window
    stress = force / (edge**2 * stretch.prod() / stretch)
    K = float(stress.mean() / (1 - stretch.prod()))
    mu = float((stress[2] - stress[0]) / (2 * (stretch[0] - stretch[2])))
    bulk = material.lame_lambda + 2 / 3 * material.shear_modulus
    shear = material.shear_modulus
    return [
        Check("confined compression: bulk modulus", K, bulk, 0.03 * bulk, "Pa"),
        Check("confined compression: shear modulus", mu, shear, 0.05 * shear, "Pa"),
    ]


def _axis(axis: int, length: float) -> np.ndarray:
    vector = np.zeros(3)
    vector[axis] = length
    return vector


def _pushes(solver: Solver) -> np.ndarray:
    """[3] impulse of the walls inwards so far, mean of both sides of each axis [N s]."""
    impulses = np.array([np.abs(c.impulse) for c in solver.contacts])
    mean: np.ndarray = impulses.sum(axis=0) / 2
    return mean


# A clamped beam: deflection and frequency (Euler and Bernoulli).

LENGTH, HEIGHT, DX = 2.0, 0.2, 0.05
MATERIAL = FixedCorotated(young=1e6, poisson=0.0, density=1000)
BENDING = MATERIAL.young * HEIGHT**4 / 12
"""E I [N m^2]."""
SHEARING = 5 / 6 * MATERIAL.shear_modulus * HEIGHT**2
"""k G A [N]."""
LINE_DENSITY = MATERIAL.density * HEIGHT**2
"""Mass per length [kg/m]."""


def cantilever(backend: str) -> list[Check]:
    """First mode of a beam, (1.875^2 / 2 pi) sqrt(E I / rho A L^4)."""
    still = _beam()
    x = still.particles.positions[:, 0]
    velocity = np.zeros((len(x), 3))
    velocity[:, 2] = 0.05 * np.clip(x / LENGTH, 0, None) ** 2
    gradient = np.zeros((len(x), 3, 3))
    gradient[:, 2, 0] = 0.1 * np.clip(x, 0, None) / LENGTH**2
    body = replace(still, particle_velocities=velocity, particle_gradients=gradient)
    exact = 1.875104**2 / (2 * np.pi) * math.sqrt(BENDING / LINE_DENSITY) / LENGTH**2
    solver = solve([body], [_clamp()], backend=backend, dx=DX)
    times, heights = _follow_tip(solver, x > LENGTH - 0.1, 0.01 / exact, 0.6 / exact)
    falls = (heights[1:] < 0) & (heights[:-1] >= 0) & (times[1:] > 0.2 / exact)
    i = int(np.flatnonzero(falls)[0])
    fraction = heights[i] / (heights[i] - heights[i + 1])
    half = times[i] + fraction * (times[i + 1] - times[i])
    oscillation = heights.max() * np.sin(2 * np.pi * exact * times)
    curve = ReferenceCurve(
        times.tolist(), heights.tolist(), oscillation.tolist(), "time [s]", "tip [m]"
    )
    return [Check("cantilever: frequency", 0.5 / half, exact, 0.05 * exact, "Hz", curve)]


def loaded_beam(backend: str, *, length: float | None = None) -> list[Check]:
    """A tip load bends a beam by P L^3 / 3 E I, in addition to the deflection by its weight.

    Released at rest, the beam oscillates about the static deflection: the mean of the initial and
    the lowest point. Shear adds (P + q L / 2) L / k G A with k = 5/6 (Timoshenko). On the slow
    reference backend, the beam is half as long by default.
    """
    L = length or (LENGTH / 2 if backend == "reference" else LENGTH)
    tip_mass, gravity, piece = LINE_DENSITY * L / 2, 0.025 * (LENGTH / L) ** 3, 0.05
    beam = _beam(L)
    x = beam.particles.positions[:, 0]
    tip = x > L - piece
    masses = np.where(tip, beam.particles.masses + tip_mass / tip.sum(), beam.particles.masses)
    body = replace(beam, particles=replace(beam.particles, masses=masses))
    a = L - piece / 2
    point = tip_mass * gravity * a**3 / (3 * BENDING)
    shape = a**2 * (6 * L**2 - 4 * L * a + a**2) / (24 * BENDING)
    shear = (tip_mass * a + LINE_DENSITY * (L * a - a**2 / 2)) * gravity / SHEARING
    exact = point + LINE_DENSITY * gravity * shape + shear
    # Rayleigh's estimate is accurate enough for the time of the lowest point.
    swinging = tip_mass + 33 / 140 * LINE_DENSITY * L
    half = math.pi * math.sqrt(swinging * a**3 / (3 * BENDING))
    solver = solve([body], [_clamp()], backend=backend, dx=DX, gravity=(0, 0, -gravity))
    times, heights = _follow_tip(solver, tip, half / 60, 1.15 * half)
    lowest = int(np.argmin(heights))
    bend = -float(np.trapezoid(heights[: lowest + 1], times[: lowest + 1]) / times[lowest])
    oscillation = -exact * (1 - np.cos(np.pi * times / times[lowest]))
    curve = ReferenceCurve(
        times.tolist(), heights.tolist(), oscillation.tolist(), "time [s]", "tip [m]"
    )
    return [Check("cantilever: bend under load", bend, exact, 0.05 * exact, "m", curve)]


def _beam(length: float = LENGTH) -> Body:
    return block(
        MATERIAL,
        size=(length + 0.2, HEIGHT, HEIGHT),
        spacing=DX / 2,
        at=(length / 2 - 0.1, 0, 0),
    )


def _clamp() -> Box:
    """A clamp for the part of the beam at x < 0."""
    return Box(
        name="clamp",
        T_world_box=placed(-1.0),
        size=(2, 4, 4),
        friction=math.inf,
        separable=False,
    )


def _follow_tip(
    solver: Solver, tip: np.ndarray, every: float, duration: float
) -> tuple[Float, Float]:
    """Times and mean heights of the tip, from the start."""
    start = float(solver.particles().positions[tip, 2].mean())
    times, heights = [0.0], [0.0]
    while solver.time < duration:
        solver.step(every)
        times.append(solver.time)
        heights.append(float(solver.particles().positions[tip, 2].mean()) - start)
    return np.array(times), np.array(heights)


# Elastic bodies in collision.

_HERTZ_POWER = 1.5 * 1.07
"""Hertz's indentation is close to sin(pi t)^(1.07), and its force is the power 3/2 of that."""


def two_discs(backend: str) -> list[Check]:
    """Sulsky's discs on the original 40 x 40 cells, and on half as many (Sulsky et al. 1994).

    The discs touch when their surfaces meet, rebound and separate. The energy loss decreases with
    the cell size.
    """
    radius, speed, finest = 0.2, 0.1, 0.025
    fine, first_contact, start = _disc_run(backend, finest)
    coarse, _, _ = _disc_run(backend, 2 * finest)
    exact = (math.hypot(0.6, 0.6) - 2 * radius) / (2 * math.sqrt(2) * speed)
    kept, kept_coarse = fine[0], coarse[0]
    return [
        Check("two discs: kinetic energy at the start, 1 m thick", start, 2.513, 0.02 * 2.513, "J"),
        # Half a cell, the uncertainty of surfaces, and one check interval of the contacts.
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
    # Motion of the discs as a whole; vibration is neither kept nor lost.
    kept = float((m.mass * (centre**2).sum(1)).sum()) / 2 / start
    apart = float(np.linalg.norm(m.centre[1] - m.centre[0]))
    return (kept, apart), first_contact, start / thickness


def stiff_discs(backend: str) -> list[Check]:
    """Two discs of 1 GPa that collide at 114 m/s swap velocities (Nairn's two-disc example).

    Vibration remains, because they collide at a seventh of the speed of sound.
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
    # The force law is symmetric: the middle 98 % of the impulse takes 0.85 of the contact.
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
    """Fraction of the contact time that contains all but ``tail`` at each end of the impulse."""
    t = np.linspace(0, 1, 2001)
    J = np.cumsum(np.sin(np.pi * t) ** _HERTZ_POWER)
    J /= J[-1]
    return float(np.interp(1 - tail, J, t) - np.interp(tail, J, t))


def disc_particles(radius: float, thickness: float, *, spacing: float, density: float) -> Particles:
    """A disc perpendicular to z, centred on the origin; volumes sum to the disc's."""
    lattice = box_particles([2 * radius, 2 * radius, thickness], spacing=spacing, density=density)
    inside = (lattice.positions[:, :2] ** 2).sum(axis=1) < radius**2
    disc = lattice.take(inside)
    volumes = np.full(len(disc), math.pi * radius**2 * thickness / len(disc))
    return replace(disc, volumes=volumes, masses=density * volumes)
