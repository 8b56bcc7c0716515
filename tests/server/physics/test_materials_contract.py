"""The contract of every material: a record with a known law, the same on every backend."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, get_args

import numpy as np
import pytest

from real2sim_proto.operations import MaterialName
from real2sim_server.physics import Body, MaterialError, Plane, box_particles
from real2sim_server.physics import materials as registry
from real2sim_server.physics.materials import (
    MATERIALS,
    VON_MISES,
    ConstitutiveLaw,
    Material,
    Structure,
    named_material,
    register_material,
)
from real2sim_server.physics.stress import LAW, MATERIAL_ROW, PLASTIC
from real2sim_server.physics.validation.check import placed

from .scenes import solve

STATE = ("positions", "velocities", "gradients", "F_elastic", "F_total", "history")
SHEARED = np.array([[1.15, 0.3, 0.0], [0.0, 0.85, 0.0], [0.0, 0.0, 1.0]])


@dataclass(frozen=True, kw_only=True)
class Clay(Material):
    """A new material: flows at a shear strength, without hardening."""

    constitutive_law: ClassVar[ConstitutiveLaw] = VON_MISES

    shear_strength: float = 2e4

    def law_parameters(self):
        return 3**0.5 * self.shear_strength, 0.0

    def _check(self):
        self._require("shear_strength", self.shear_strength > 0, "must be positive")


@pytest.fixture(params=[*MATERIALS, "clay", "structure"])
def material(request, monkeypatch) -> Material:
    monkeypatch.setattr(registry, "MATERIALS", dict(MATERIALS))
    register_material("clay", young=5e6, density=1800.0)(Clay)
    register_material("structure", young=5e6, critical_compression=0.02)(Structure)
    return named_material(request.param)


def thrown(material: Material, backend: str, deformation=None):
    """A small cube hitting the ground, in a number of stable substeps."""
    particles = box_particles([0.2] * 3, spacing=0.05, density=material.density)
    F = None if deformation is None else np.tile(deformation, (len(particles), 1, 1))
    body = Body(
        name="cube",
        particles=particles.moved(placed(0.03, 0.0, 0.11)),
        material=material,
        velocity=(1.0, 0.0, -5.0),
        deformation=F,
    )
    return solve([body], [Plane(name="ground")], backend=backend, precision="double")


def test_a_materials_row_holds_law_and_plasticity(material):
    row = material.row()
    assert row.shape == (MATERIAL_ROW,)
    assert np.isfinite(row).all()
    assert row[LAW] == material.constitutive_law.code
    assert bool(row[PLASTIC]) == material.plastic == material.constitutive_law.plastic


def test_a_material_at_rest_stores_no_energy(material):
    assert thrown(material, "cpu").measure.elastic[0] == 0.0


def test_backends_agree_on_every_material(material):
    runs = [thrown(material, backend) for backend in ("reference", "cpu")]
    duration = 25 * runs[0].time_step()
    for run in runs:
        run.step(duration)
    expected, found = (run.particles() for run in runs)
    for name in STATE:
        scale = 1 + np.abs(getattr(expected, name)).max()
        error = np.abs(getattr(found, name) - getattr(expected, name)).max()
        assert error < 1e-6 * scale, name


def test_a_material_gains_no_energy(material):
    run = thrown(material, "cpu")
    start = run.energies().total
    run.step(100 * run.time_step())
    assert run.energies().total <= start * (1 + 1e-3)


def test_only_plastic_materials_have_separate_deformations(material):
    run = thrown(material, "cpu", SHEARED)
    run.step(run.time_step())
    state = run.particles()
    apart = np.abs(state.F_total - state.F_elastic).max()
    assert apart > 1e-3 if material.plastic else apart == 0.0


def test_every_material_name_in_operations_exists():
    assert set(get_args(MaterialName)) == set(MATERIALS)


def test_duplicate_and_unknown_names_are_refused():
    with pytest.raises(MaterialError, match="'metal' is there already"):
        register_material("metal")(Clay)
    with pytest.raises(MaterialError, match="unknown material 'granite'; allowed are jelly"):
        named_material("granite")


def test_a_material_with_an_unknown_law_is_refused():
    @dataclass(frozen=True, kw_only=True)
    class Granite(Material):
        constitutive_law: ClassVar[ConstitutiveLaw] = ConstitutiveLaw("brittle", 17, plastic=False)

    with pytest.raises(MaterialError, match="law 'brittle' of Granite; allowed are fixed_coro"):
        Granite(young=5e10)


def test_a_material_without_a_law_is_refused():
    with pytest.raises(MaterialError, match="law None of Material; allowed are fixed_corotated"):
        Material(young=1e6)


def test_a_material_with_too_few_law_parameters_is_refused():
    class Short(Clay):
        def law_parameters(self):
            return (1.0,)

    with pytest.raises(MaterialError, match="1 parameters to the law 'von_mises'; it takes 2"):
        Short(young=1e6).row()


def test_a_model_with_an_unknown_law_in_its_table_is_refused():
    model = thrown(named_material("jelly"), "cpu").model
    table = model.table.copy()
    table[:, LAW] = 17
    with pytest.raises(MaterialError, match=r"unknown constitutive law 17.*drucker_prager"):
        replace(model, table=table)
