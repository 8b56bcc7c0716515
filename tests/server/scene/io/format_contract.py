"""The contract of splat formats."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import get_args

import pytest
import torch

from real2sim_server.scene import BundleError, GaussianCloud
from real2sim_server.scene.io import read_splats, write_splats
from real2sim_server.scene.io.splat_format import SplatFormat, UpAxis
from real2sim_server.scene.io.splats import FORMATS

MakeCloud = Callable[..., GaussianCloud]


def check_description(splat_format: SplatFormat) -> None:
    """Name and suffix are unique, and foreign files are not recognised."""
    others = [known for known in FORMATS if known is not splat_format]
    assert splat_format.name not in {known.name for known in others}
    assert splat_format.suffix not in {known.suffix for known in others}
    assert splat_format.suffix == splat_format.suffix.lower()
    assert splat_format.suffix.startswith(".")
    assert splat_format.up_axis in get_args(UpAxis)
    assert not splat_format.recognises(b"")
    assert not splat_format.recognises(bytes(100))


def check_file_is_its_own(splat_format: SplatFormat, cloud: GaussianCloud, folder: Path) -> None:
    """Written files are recognised by their own format first."""
    path = folder / f"named{splat_format.suffix}"
    write_splats(cloud, path)
    head = path.read_bytes()[: 1 << 16]
    claims = [known for known in FORMATS if known.recognises(head)]
    assert claims[:1] == ([splat_format] if splat_format.has_signature else [])


def check_round_trip(splat_format: SplatFormat, make_cloud: MakeCloud, folder: Path) -> None:
    """Written Gaussians are read back: valid, complete and near their positions."""
    for degree in range(4):
        cloud = make_cloud(300, degree=degree)
        path = folder / f"{degree}{splat_format.suffix}"
        write_splats(cloud, path)
        back = read_splats(path)
        back.check_values("back")
        assert len(back) == 300
        assert back.sh_degree in {0, degree}
        nearest = torch.cdist(cloud.means.double(), back.means.double()).amin(dim=1)
        assert nearest.max() < 0.1


def check_same_bytes(splat_format: SplatFormat, make_cloud: MakeCloud, folder: Path) -> None:
    """Equal Gaussians give equal files."""
    written = []
    for name in "ab":
        path = folder / f"{name}{splat_format.suffix}"
        write_splats(make_cloud(100, degree=1), path)
        written.append(path.read_bytes())
    assert written[0] == written[1]


def check_damage_is_refused(splat_format: SplatFormat, cloud: GaussianCloud, folder: Path) -> None:
    """A truncated file is refused with its name."""
    path = folder / f"cut{splat_format.suffix}"
    write_splats(cloud, path)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2 + 1])
    with pytest.raises(BundleError, match=f"cut{splat_format.suffix}"):
        splat_format.read(path)


def check_contract(splat_format: SplatFormat, make_cloud: MakeCloud, folder: Path) -> None:
    """Run all checks of the contract."""
    check_description(splat_format)
    check_file_is_its_own(splat_format, make_cloud(20), folder)
    check_round_trip(splat_format, make_cloud, folder)
    check_same_bytes(splat_format, make_cloud, folder)
    check_damage_is_refused(splat_format, make_cloud(20), folder)
