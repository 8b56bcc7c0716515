"""Images are bit-identical for any number of threads and in any process."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from collections.abc import Callable

import numba
import numpy as np
import torch

from real2sim_server.render import Instance, RenderOutput, rasterize
from real2sim_server.render._cpu.drawing import cluster_of, places_of
from real2sim_server.render.backend import place_instances
from real2sim_server.render.images import solid_depth, to_uint8
from real2sim_server.scene import GaussianCloud, Sky

K = np.array([[[200.0, 0, 100], [0, 200, 75], [0, 0, 1]]])


def scene() -> list[Instance]:
    generator = np.random.default_rng(5)
    n = 30_000
    parts = (
        generator.uniform((-5, -4, 0.5), (5, 4, 12), (n, 3)),
        generator.normal(size=(n, 4)),
        np.exp(generator.uniform(-5, -2, (n, 3))),
        generator.uniform(0, 1, n),
        generator.normal(0, 0.3, (n, 4, 3)),
    )
    cloud = GaussianCloud(*(torch.from_numpy(part.astype(np.float32)) for part in parts))
    return [Instance(cloud), Instance(cloud.select(torch.arange(5000)), np.eye(4), 3)]


def draw(instances: list[Instance], *, between: Callable[[], object] | None = None) -> RenderOutput:
    sky = Sky(torch.linspace(0, 1, 6 * 4 * 4 * 3).reshape(6, 4, 4, 3))
    return rasterize(
        instances, np.eye(4)[None], K, 200, 150, sky=sky, backend="cpu", between=between
    )


def digest(output: RenderOutput) -> str:
    assert output.depth is not None
    assert output.instance is not None
    images = (output.rgb, output.alpha, output.depth, output.instance)
    return hashlib.sha256(b"".join(image.numpy().tobytes() for image in images)).hexdigest()


def test_images_do_not_depend_on_the_number_of_threads() -> None:
    instances = scene()
    digests = set()
    threads = numba.get_num_threads()
    try:
        for count in range(1, threads + 1):
            numba.set_num_threads(count)
            digests.add(digest(draw(instances)))
    finally:
        numba.set_num_threads(threads)
    assert len(digests) == 1


def test_images_do_not_depend_on_earlier_images() -> None:
    instances = scene()
    first = digest(draw(instances))
    draw(instances[1:])
    rasterize(instances, np.eye(4)[None], K * [[[2.0], [2], [1]]], 400, 300, backend="cpu")
    assert digest(draw(instances)) == first


def test_a_new_single_threaded_process_gives_the_same_image() -> None:
    program = (
        "import importlib.util, sys\n"
        f"spec = importlib.util.spec_from_file_location('t', {__file__!r})\n"
        "module = importlib.util.module_from_spec(spec); spec.loader.exec_module(module)\n"
        "print(module.digest(module.draw(module.scene())))"
    )
    result = subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "NUMBA_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(sys.path)},
    )
    assert result.stdout.strip() == digest(draw(scene()))


def test_images_drawn_in_bands_are_the_same(monkeypatch) -> None:  # type: ignore[no-untyped-def]
    instances = scene()
    whole = digest(draw(instances))
    monkeypatch.setattr("real2sim_server.render._cpu.drawing.LIST_BUDGET", 2000)
    assert digest(draw(instances)) == whole


def test_interleaved_drawing_does_not_change_images(monkeypatch) -> None:  # type: ignore[no-untyped-def]
    monkeypatch.setattr("real2sim_server.render._cpu.drawing.PIECE_PIXELS", 4000)
    instances = scene()
    whole, other = digest(draw(instances)), digest(draw(instances[1:]))
    between = []

    def draw_another() -> None:
        between.append(digest(draw(instances[1:])))

    assert digest(draw(instances, between=draw_another)) == whole
    assert len(between) > 15
    assert set(between) == {other}


def test_piecewise_conversion_gives_the_same_images(monkeypatch) -> None:  # type: ignore[no-untyped-def]
    monkeypatch.setattr("real2sim_server.render.images.PIECE", 777)
    output, pieces = draw(scene()), []
    assert output.depth is not None
    whole = to_uint8(output.rgb), solid_depth(output.depth, output.alpha)
    levels = to_uint8(output.rgb, between=lambda: pieces.append("rgb"))
    depths = solid_depth(output.depth, output.alpha, between=lambda: pieces.append("depth"))
    assert np.array_equal(levels, whole[0])
    assert np.array_equal(depths, whole[1])
    assert (pieces.count("rgb"), pieces.count("depth")) == (116, 39)


def test_clouds_are_not_copied() -> None:
    (instance, _) = scene()
    places = places_of(place_instances([instance], torch.eye(4, dtype=torch.float64)[None]), 0)
    cluster = cluster_of(instance, places, 0)
    for name in ("means", "quats", "scales", "opacities", "sh"):
        tensor = getattr(instance.cloud, name)
        assert np.shares_memory(getattr(cluster, name), tensor.numpy()), name
