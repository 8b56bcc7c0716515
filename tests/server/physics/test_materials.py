"""Materials: what they refuse, and how they respond to compression."""

from __future__ import annotations

import math

import numpy as np
import pytest

from real2sim_server.physics import (
    Body,
    FixedCorotated,
    Foam,
    MaterialError,
    Metal,
    NearRigid,
    NeoHookean,
    Sand,
    Snow,
    box_particles,
)

from .scenes import cube, solve


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: FixedCorotated(young=-1), "young of FixedCorotated must be positive"),
        (lambda: FixedCorotated(young=0), "young of FixedCorotated must be positive"),
        (lambda: FixedCorotated(young=float("nan")), "finite"),
        (lambda: FixedCorotated(young="soft"), "finite"),
        (lambda: FixedCorotated(young=1e5, poisson=0.5), "0.5 is incompressible"),
        (lambda: FixedCorotated(young=1e5, poisson=-1), r"\(-1, 0.5\)"),
        (lambda: FixedCorotated(young=1e5, density=0), "density"),
        (lambda: FixedCorotated(young=1e5, viscosity=-1), "viscosity"),
        (lambda: Metal(young=1e5, yield_stress=0), "yield_stress"),
        (lambda: Metal(young=1e5, yield_stress=1, hardening=-1), "hardening"),
        (lambda: Foam(young=1e5, yield_stress=1, plastic_viscosity=-1), "plastic_viscosity"),
        (lambda: Sand(friction_angle=2.0), "friction_angle"),
        (lambda: Snow(critical_compression=1.5), "critical_compression"),
        (lambda: Snow(critical_stretch=0), "critical_stretch"),
    ],
)
def test_impossible_parameters_are_refused_by_name(make, words):
    with pytest.raises(MaterialError, match=words):
        make()


def test_moduli_follow_from_youngs_modulus_and_poissons_ratio():
    soft = FixedCorotated(young=2e6, poisson=0.4, density=200)
    assert soft.shear_modulus == pytest.approx(2e6 / 2.8)
    assert soft.lame_lambda == pytest.approx(2e6 * 0.4 / (1.4 * 0.2))
    assert soft.wave_speed == pytest.approx(146.4, abs=0.1)


def stressed(material, F):
    """A body held at one deformation, after one tiny step."""
    particles = box_particles([0.4] * 3, spacing=0.05, density=200)
    held = np.tile(np.asarray(F, float), (len(particles), 1, 1))
    body = Body(name="held", particles=particles, material=material, deformation=held)
    solver = solve([body], backend="cpu", precision="double", gravity=(0, 0, 0), dt_max=1e-9)
    solver.step(1e-9)
    inner = np.abs(particles.positions).max(axis=1) < 0.05
    return solver.particles().F_elastic[inner].mean(0), solver


def test_metal_returns_to_its_yield_surface_and_keeps_the_dent():
    metal = Metal(young=1e6, poisson=0.3, yield_stress=1e4)
    shear = np.array([[1, 0.2, 0], [0, 1, 0], [0, 0, 1]])
    F, solver = stressed(metal, shear)
    e = 0.5 * np.log(np.linalg.eigvalsh(F @ F.T))
    deviator = e - e.mean()
    stress = 2 * metal.shear_modulus * np.linalg.norm(deviator)
    assert stress == pytest.approx(math.sqrt(2 / 3) * 1e4, rel=1e-4)
    assert np.linalg.det(F) == pytest.approx(np.linalg.det(shear), rel=1e-6)
    total = solver.particles().F_total
    np.testing.assert_allclose(total.mean(0), shear, atol=1e-6)


def test_hardening_raises_the_yield_stress_during_flow():
    shear = np.array([[1, 0.2, 0], [0, 1, 0], [0, 0, 1]])
    soft = Metal(young=1e6, yield_stress=1e4)
    hard = Metal(young=1e6, yield_stress=1e4, hardening=2e5)
    assert stressed(hard, shear)[1].measure.elastic > 2 * stressed(soft, shear)[1].measure.elastic
    assert stressed(hard, shear)[1].particles().history.min() > 1e3


def test_foam_needs_time_to_flow():
    shear = np.array([[1, 0.2, 0], [0, 1, 0], [0, 0, 1]])
    slow = stressed(Foam(young=1e6, yield_stress=1e4, plastic_viscosity=1e3), shear)[0]
    quick = stressed(Foam(young=1e6, yield_stress=1e4, plastic_viscosity=0), shear)[0]
    strains = [np.abs(np.log(np.linalg.svd(F)[1])).max() for F in (slow, quick)]
    assert strains[0] == pytest.approx(np.arcsinh(0.1), rel=1e-3)
    assert strains[1] < 0.02


def test_sand_carries_pressure_but_no_tension():
    pulled = stressed(Sand(), np.eye(3) * 1.01)[1].measure.elastic[0]
    pressed = stressed(Sand(), np.eye(3) * 0.99)[1].measure.elastic[0]
    assert abs(pulled) < 1e-9
    assert pressed > 1


def test_snow_carries_stress_and_hardens_when_packed():
    lightly = stressed(Snow(), np.eye(3) * 0.99)[1].measure.elastic[0]
    packed = stressed(Snow(), np.eye(3) * 0.9)
    assert lightly > 1
    assert packed[1].particles().history.max() < -0.1
    # Beyond critical compression the strain is fixed, so only hardening can raise the energy.
    edge = stressed(Snow(), np.eye(3) * 0.975)[1].measure.elastic[0]
    assert packed[1].measure.elastic[0] > 1.5 * edge


@pytest.mark.parametrize(
    "material",
    [FixedCorotated(young=1e5), NeoHookean(young=1e5), NearRigid()],
    ids=lambda m: type(m).__name__,
)
def test_elastic_bodies_have_a_single_deformation(material):
    run = solve([cube(material=material, angular_velocity=(0, 0, 20))], backend="cpu")
    run.step(0.002)
    state = run.state("cube")
    assert (state.F_elastic == state.F_total).all()
    assert np.abs(state.F_elastic - np.eye(3)).max() > 1e-3
