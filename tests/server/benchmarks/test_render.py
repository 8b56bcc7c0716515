"""The render bench measures real images."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from real2sim_bench import render as bench
from real2sim_server.render import rasterize
from real2sim_server.synthetic.gaussian_street import street_scene


def test_the_street_has_the_requested_count_and_is_deterministic() -> None:
    first, second = street_scene(120_000), street_scene(120_000)
    assert first.gaussian_count == 120_000
    assert np.array_equal(first.instances[0].cloud.means, second.instances[0].cloud.means)


def test_the_street_image_shows_road_cars_and_sky() -> None:
    street = street_scene(120_000, width=96, height=64)
    camera = street.camera
    out = rasterize(
        street.instances,
        camera.viewmat(street.T_world_vehicle)[None],
        camera.K[None],
        96,
        64,
        sky=street.sky,
        backend="cpu",
    )
    assert out.instance is not None
    assert float(out.alpha[0, -10:].mean()) > 0.9
    assert float(out.alpha[0, 0, 48]) == 0
    assert len(out.instance.int().unique()) > 6


def test_the_report_is_printed_and_json_serializable(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(bench, "REDUCED_GAUSSIANS", 300)
    monkeypatch.setenv("REAL2SIM_TEST_DATA", str(tmp_path))
    small = street_scene(120_000)
    monkeypatch.setattr(bench, "street_scene", lambda count: small)
    result = bench.run(backend="cpu", repetitions=1)
    assert json.loads(json.dumps(result)) == result
    (street,) = result["cases"]
    assert street["gaussians"] == 120_000
    assert street["reduced"]["reference_ms"] > 0
    assert street["rgb"]["stages_ms"]["blend"] > 0
    assert "No splat was measured" in result["notes"][0]
    assert "street" in capsys.readouterr().out


def test_the_splat_case_has_the_asset_in_view(test_data: Path) -> None:
    case = bench.splat_case(test_data / "splats" / "biker.compressed.ply")
    assert (case.width, case.height, case.gaussian_count) == (1920, 1280, 152_746)
    small = case.reduced()
    out = rasterize(
        small.instances,
        small.viewmat[None],
        small.K[None],
        small.width,
        small.height,
        backend="cpu",
    )
    covered = float((out.alpha > 0.5).float().mean())
    assert 0.05 < covered < 0.5
