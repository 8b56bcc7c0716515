"""Machine code of the generator on disk is that of its sources; see also tests of _numba."""

from __future__ import annotations

import pytest

from real2sim_server._numba import fingerprint
from real2sim_server.synthetic import casting, materials, sensors

DARK_EXPOSURE = 0.072


@pytest.mark.parametrize(
    ("module", "name", "value"),
    [(sensors, "EXPOSURE", DARK_EXPOSURE), (materials, "_VALUE", materials._VALUE[::-1].copy())],
)
def test_the_key_of_the_image_kernel_covers_constants_of_other_files(
    monkeypatch: pytest.MonkeyPatch, module, name, value
) -> None:
    before = fingerprint(sensors._shoot)
    monkeypatch.setattr(module, name, value)
    assert fingerprint(sensors._shoot) != before


def test_the_key_of_the_lidar_kernel_covers_the_materials(monkeypatch: pytest.MonkeyPatch) -> None:
    before = fingerprint(sensors.shoot_lidar)
    monkeypatch.setattr(materials, "WINDOW", materials.WINDOW + 100)
    assert fingerprint(sensors.shoot_lidar) != before


def test_kernels_that_python_calls_are_kept_and_all_others_are_part_of_them() -> None:
    kept = (sensors._shoot, sensors._find_edges, sensors.shoot_lidar, casting._build)
    assert all(kernel._cache.__class__.__name__ == "_KernelCache" for kernel in kept)
    parts = (sensors.sky_colour, materials.hash01, materials.static_surface, casting._partition)
    assert all(part._cache.__class__.__name__ == "NullCache" for part in parts)
