"""The GPU check, run on the pretended device."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import pytest

from real2sim_server.cli.gpu_check import PARTS, Devices, FrameCase, Scale, run
from real2sim_server.render._cuda.serving import NvrtcBackend
from real2sim_server.render.backend import Backend
from real2sim_server.render.cast.cuda import CudaCaster

from ..render.kernel_twin import COMPILER, NEEDS_COMPILER
from . import pretended
from .pretended_launcher import PretendedCastLauncher, PretendedLauncher

pytestmark = pytest.mark.skipif(COMPILER is None, reason=NEEDS_COMPILER)
SMALL = Scale(
    compared=1500,
    compared_width=32,
    frames=(
        FrameCase(1, 32, 16, 1000, 2),
        FrameCase(5, 32, 16, 1000, 3, wanted_ms=1e9, jpeg=True),
    ),
    repeats=2,
    rays=(8, 32),
    particles=(1000,),
    train_steps=2,
    train_width=32,
    train_frames=2,
    train_gaussians=100,
)


def devices(training: str | Backend = "cpu") -> Devices:
    casting = partial(CudaCaster, PretendedCastLauncher())
    return Devices(lambda: NvrtcBackend(PretendedLauncher()), training, "cpu", casting, "pretended")


def test_images_and_timings_are_checked_and_reported_as_a_table(
    device_counts: pretended.Counts,
) -> None:
    check = run(devices(), SMALL, parts=["images", "lidar", "frames", "memory"])
    assert check.failed == {}
    assert check.right
    text = check.markdown()
    assert text.startswith(f"Checked on {check.date}: pretended\n\n| Part |")
    assert ": jpeg by libjpeg-turbo" in text
    assert "10 km from the origin | 0 | 0 (met) |" in text
    assert "rays that hit another Gaussian | 0.000% | 0.1 % (met) |" in text


def test_a_failing_part_reports_its_error_and_the_others_run() -> None:
    def broken() -> Backend:
        raise RuntimeError("CUDA error: no kernel image")

    check = run(replace(devices(), serving=broken), SMALL, parts=["frames", "memory"])
    assert check.failed == {"frames": "RuntimeError: CUDA error: no kernel image"}
    assert not check.right
    assert [finding.part for finding in check.findings] == ["memory"]
    assert "| frames | failed | RuntimeError" in check.markdown()


@pytest.mark.slow
def test_all_parts_run(device_counts: pretended.Counts, cuda_backend: Backend) -> None:
    begun: list[str] = []
    check = run(devices(cuda_backend), SMALL, on_part=begun.append)
    assert check.failed == {}
    assert begun == list(PARTS)
    assert {finding.part for finding in check.findings} == set(PARTS)
