"""A splat format from outside the package: the CSV of PlayCanvas' splat-transform.

A header line names the columns of a trained PLY: log scales, logit opacities, rotation wxyz and
spherical harmonics channel by channel. After one call of ``register_format`` the format can be
read, written, imported and exported like the others.
"""

from pathlib import Path

import numpy as np
import pytest

from real2sim_server._files import atomic_file
from real2sim_server.scene import BundleError, GaussianCloud
from real2sim_server.scene.io import export_scene, import_splats, splat_format
from real2sim_server.scene.io.ply import InriaPly
from real2sim_server.scene.io.splat_format import UpAxis
from real2sim_server.scene.io.splats import FORMATS, register_format

from .format_contract import check_contract

COLUMNS = ["x", "y", "z", "opacity"]
COLUMNS += [f"{name}_{k}" for name, n in (("scale", 3), ("rot", 4), ("f_dc", 3)) for k in range(n)]


class SplatCsv:
    """CSV with constant colours. Numbers are the shortest text that round-trips."""

    name = "splat-transform CSV"
    suffix = ".csv"
    has_signature = True
    up_axis: UpAxis = "z"

    def recognises(self, head: bytes) -> bool:
        return head.startswith(",".join(COLUMNS).encode())

    def read(
        self, path: Path, *, max_bytes: int | None = None, notes: list[str] | None = None
    ) -> GaussianCloud:
        lines = path.read_text(encoding="ascii").split("\n")
        if lines[-1]:
            raise BundleError(f"{path}: its last line is cut off")
        splat_format.check_memory(path, len(lines) - 2, 1, max_bytes)
        rows = np.array([line.split(",") for line in lines[1:-1]], dtype=np.float64)
        means, logits, scales, quats, colours = np.split(rows, [3, 4, 7, 11], axis=1)
        return splat_format.build_cloud(
            path,
            means=means,
            quats=quats,
            log_scales=scales,
            opacities=1 / (1 + np.exp(-logits[:, 0])),
            sh=colours[:, None, :],
            notes=notes,
        )

    def write(self, cloud: GaussianCloud, path: Path) -> None:
        opacities = splat_format.host_array(cloud.opacities)[:, None].clip(1e-9, 1 - 1e-9)
        parts = [
            splat_format.host_array(cloud.means),
            np.log(opacities / (1 - opacities)),
            np.log(splat_format.host_array(cloud.scales)),
            splat_format.host_array(cloud.quats),
            splat_format.host_array(cloud.sh[:, 0]),
        ]
        lines = [",".join(map(repr, row)) for row in np.concatenate(parts, axis=1).tolist()]
        with atomic_file(path) as file:
            file.write("\n".join([",".join(COLUMNS), *lines, ""]).encode("ascii"))


@pytest.fixture
def csv():
    """Register the format for one test."""
    before = FORMATS[:]
    splat_csv = SplatCsv()
    register_format(splat_csv)
    yield splat_csv
    FORMATS[:] = before


def test_the_format_fulfils_the_contract(csv, make_cloud, tmp_path):
    check_contract(csv, make_cloud, tmp_path)


def test_scenes_are_exported_and_imported(csv, scene, tmp_path):
    (file,) = export_scene(scene, tmp_path / "a.csv", format="csv", t_us=scene.start_us)
    imported = import_splats(file, name="again")
    assert len(imported.background) == scene.gaussian_count


def test_a_registered_name_or_suffix_is_refused(csv):
    with pytest.raises(ValueError, match=r"INRIA ply \(\.ply\) is registered already"):
        register_format(InriaPly())
