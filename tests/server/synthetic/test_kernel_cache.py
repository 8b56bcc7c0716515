"""Machine code of the generator on disk is that of its sources."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import real2sim_server
from real2sim_server._numba import fingerprint
from real2sim_server.synthetic import bvh, light, materials, noise, sensors

DARK_EXPOSURE = 0.072
MEAN_OF_A_PICTURE = """
from real2sim_server.synthetic import CameraSpec, SyntheticConfig, generate_log
config = SyntheticConfig(frames=1, width=32, height=24, samples=1, cameras=(CameraSpec("front"),))
print(generate_log(config).image("front", 0).mean())
"""


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A copy of the server's package without machine code."""
    source = Path(real2sim_server.__file__).parent
    ignored = shutil.ignore_patterns("__pycache__", "*.zip")
    return Path(shutil.copytree(source, tmp_path / source.name, ignore=ignored))


def mean_of_a_picture(package: Path) -> float:
    path = os.pathsep.join([str(package.parent), os.environ.get("PYTHONPATH", "")])
    command = [sys.executable, "-c", MEAN_OF_A_PICTURE]
    # Without optimisation, which is what takes most of the time.
    environment = os.environ | {"PYTHONPATH": path, "NUMBA_OPT": "0"}
    run = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    return float(run.stdout)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_constant_changed_in_another_file_changes_the_picture_of_the_next_process(
    package: Path,
) -> None:
    before = mean_of_a_picture(package)
    assert before > 60
    file = package / "synthetic" / "light.py"
    source = file.read_text()
    changed = source.replace(f"EXPOSURE = {light.EXPOSURE}", f"EXPOSURE = {DARK_EXPOSURE}")
    assert changed != source
    file.write_text(changed)
    assert mean_of_a_picture(package) < before / 1.5


@pytest.mark.parametrize(
    ("module", "name", "value"),
    [(light, "EXPOSURE", DARK_EXPOSURE), (noise, "_VALUE", noise._VALUE[::-1].copy())],
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
    kept = (sensors._shoot, sensors._find_edges, sensors.shoot_lidar, bvh._build)
    assert all(kernel._cache.__class__.__name__ == "_KernelCache" for kernel in kept)
    parts = (light.sky_colour, noise.hash01, materials.static_surface, bvh._partition)
    assert all(part._cache.__class__.__name__ == "NullCache" for part in parts)
