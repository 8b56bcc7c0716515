"""The contract of rendering backends: images match the reference within 1/255."""

from __future__ import annotations

import numpy as np
import torch

from real2sim_server.geometry import transform_from
from real2sim_server.render import Instance, RasterOptions, RenderOutput, rasterize
from real2sim_server.scene import GaussianCloud, Sky

WIDTH, HEIGHT = 90, 70
K = np.array([[80.0, 0, 45], [0, 85, 35], [0, 0, 1]])


def check_contract(backend: str) -> None:
    """Run all checks of the contract."""
    check_images(backend)
    check_what_was_not_asked_for(backend)
    check_repetition(backend)


def check_images(backend: str) -> None:
    """Images match the reference for several cameras, poses, SH degrees and modes."""
    for mode in ("classic", "antialiased"):
        options = RasterOptions(background=(0.2, 0.4, 0.6), rasterize_mode=mode, median_depth=True)
        given, expected = _draw(backend, options), _draw("reference", options)
        difference = (given.rgb.cpu() - expected.rgb).abs().amax(dim=-1)
        assert float(difference.mean()) < 1e-4
        assert float((difference > 1 / 255).float().mean()) < 1e-3
        torch.testing.assert_close(given.alpha.cpu(), expected.alpha, rtol=0, atol=1 / 255)
        assert given.depth is not None
        assert expected.depth is not None
        solid = expected.alpha > 0.1
        torch.testing.assert_close(
            given.depth.cpu()[solid], expected.depth[solid], rtol=0.01, atol=1e-3
        )
        assert given.instance is not None
        assert expected.instance is not None
        sure = (expected.alpha - 0.5).abs() > 1e-3
        assert torch.equal(given.instance.cpu()[sure], expected.instance[sure])
        assert set(expected.instance.int().unique().tolist()) == {0, 3, 65_535}
        assert given.median_depth is not None
        assert expected.median_depth is not None
        apart = (given.median_depth.cpu() - expected.median_depth).abs()
        assert float((apart[sure] > 1e-3).float().mean()) < 1e-3
        assert bool(((expected.median_depth > 0) == (expected.alpha >= 0.5)).all())


def check_what_was_not_asked_for(backend: str) -> None:
    """Requested images do not depend on the other outputs. The others are None."""
    names = ("depth", "instance", "median_depth")
    everything = _draw(backend, RasterOptions(median_depth=True))
    for asked in ((), *((name,) for name in names), ("depth", "instance")):
        drawn = _draw(backend, RasterOptions(**{name: name in asked for name in names}))
        assert torch.equal(drawn.rgb, everything.rgb)
        for name in names:
            image, expected = getattr(drawn, name), getattr(everything, name)
            assert image is None if name not in asked else torch.equal(image, expected)


def check_repetition(backend: str) -> None:
    """Equal requests give identical images."""
    first, second = (_draw(backend, RasterOptions()) for _ in range(2))
    assert torch.equal(first.rgb, second.rgb)
    assert torch.equal(first.alpha, second.alpha)


def _draw(backend: str, options: RasterOptions) -> RenderOutput:
    pose = transform_from([0.5, 0.2, 6.0], np.array([0.9, 0.1, -0.3, 0.2]))
    generator = torch.Generator().manual_seed(1)
    covars = torch.diag_embed(torch.rand(200, 3, generator=generator) * 0.02)
    instances = [
        Instance(_cloud(0)),
        Instance(_cloud(1, bands=4), pose, 3, scale=(0.5, 0.2, 0.4)),
        Instance(_cloud(2, bands=1), pose @ pose, 65_535, covars=covars),
    ]
    viewmats = np.stack([np.eye(4), transform_from([0.3, 0, 1], np.array([0.95, 0.1, 0.2, 0]))])
    sky = Sky(torch.rand(6, 5, 5, 3, generator=generator))
    return rasterize(
        instances,
        viewmats,
        np.repeat(K[None], 2, 0),
        WIDTH,
        HEIGHT,
        sky=sky,
        options=options,
        backend=backend,
    )


def _cloud(seed: int, *, bands: int = 16) -> GaussianCloud:
    rng = np.random.default_rng(seed)
    parts = (
        rng.uniform((-4, -3, -1.5), (4, 3, 10), (200, 3)),
        rng.normal(size=(200, 4)),
        np.exp(rng.uniform(-3.5, -0.7, (200, 3))),
        rng.uniform(0, 1, 200),
        rng.normal(0, 0.3, (200, bands, 3)),
    )
    return GaussianCloud(*(torch.from_numpy(part.astype(np.float32)) for part in parts))
