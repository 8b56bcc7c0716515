"""Edge cases of gradients: zeros, finite values and determinism."""

from __future__ import annotations

import math

import numba
import numpy as np
import pytest
import torch
from torch import Tensor

from real2sim_server.render import Instance, RasterOptions, RenderError, RenderOutput, rasterize
from real2sim_server.scene import GaussianCloud, Sky

WIDTH, HEIGHT = 40, 30
K = np.array([[[40.0, 0, 20], [0, 40, 15], [0, 0, 1]]])
SH_C0 = 0.28209479177387814
PARTS = ("means", "quats", "scales", "opacities", "sh")
both = pytest.mark.parametrize("backend", ["cpu", "reference"])
Leaves = dict[str, Tensor]


def leaves_of(
    means: list[list[float]], *, opacity: float = 0.5, sigma: float = 0.2, bands: int = 1
) -> Leaves:
    n = len(means)
    sh = torch.zeros(n, bands, 3)
    sh[:, 0] = torch.tensor([0.3, 0.1, -0.2])
    return {
        "means": torch.tensor(means, dtype=torch.float32).reshape(n, 3),
        "quats": torch.tensor([[1.0, 0.2, 0, 0]]).repeat(n, 1),
        "scales": torch.full((n, 3), sigma),
        "opacities": torch.full((n,), opacity),
        "sh": sh,
    }


def draw(leaves: Leaves, backend: str, **options: object) -> RenderOutput:
    for leaf in leaves.values():
        leaf.requires_grad_()
    cloud = GaussianCloud(*(leaves[part] for part in PARTS))
    return rasterize(
        [Instance(cloud)],
        np.eye(4)[None],
        K,
        WIDTH,
        HEIGHT,
        options=RasterOptions(**options),  # type: ignore[arg-type]
        backend=backend,
    )


def backward(output: RenderOutput) -> None:
    assert output.depth is not None
    (output.rgb.sum() + output.alpha.square().sum() + 0.1 * output.depth.sum()).backward()


def gradient(leaves: Leaves, part: str) -> Tensor:
    grad = leaves[part].grad
    assert grad is not None
    return grad


@both
@pytest.mark.parametrize(
    ("position", "opacity"),
    [([0, 0, -3.0], 0.5), ([50.0, 0, 3], 0.5), ([0, 0, 3.0], 0.0), ([0, 0, 0.0], 0.5)],
    ids=["behind the camera", "off the image", "opacity 0", "at the camera"],
)
def test_gradients_of_invisible_gaussians_are_zero(
    backend: str, position: list[float], opacity: float
) -> None:
    leaves = leaves_of([[0.1, 0, 3], position])
    leaves["opacities"][1] = opacity
    backward(draw(leaves, backend))
    for part in PARTS:
        assert gradient(leaves, part)[0].any(), part
        assert not gradient(leaves, part)[1].any(), part


@both
def test_gradients_of_hidden_gaussians_are_zero(backend: str) -> None:
    wall = [[0.0, 0, 2 + 0.1 * k] for k in range(4)]
    leaves = leaves_of([*wall, [0, 0, 5]], opacity=0.99)
    leaves["scales"][:4] = 10
    with torch.no_grad():
        leaves["scales"][4] = 0.1
    backward(draw(leaves, backend))
    for part in PARTS:
        assert gradient(leaves, part)[0].any(), part
        assert not gradient(leaves, part)[4].any(), part


@both
def test_capped_alpha_passes_only_colour_and_depth_gradients(backend: str) -> None:
    leaves = leaves_of([[0, 0, 3]], opacity=1.0, sigma=1000.0)
    output = draw(leaves, backend)
    assert output.depth is not None
    backward(output)
    assert float(output.alpha.detach().min()) == pytest.approx(0.999)
    for part in ("quats", "scales", "opacities"):
        assert not gradient(leaves, part).any(), part
    pixels = WIDTH * HEIGHT
    assert float(gradient(leaves, "sh")[0, 0, 0]) == pytest.approx(0.999 * SH_C0 * pixels, rel=1e-4)
    assert gradient(leaves, "means")[0].tolist() == pytest.approx([0, 0, 0.1 * pixels], rel=1e-4)


@both
def test_clamped_colour_has_no_gradient(backend: str) -> None:
    leaves = leaves_of([[0, 0, 3]], bands=4)
    leaves["sh"][0, 0] = torch.tensor([-5.0, 1.0, -5.0])
    backward(draw(leaves, backend))
    by_sh = gradient(leaves, "sh")[0]
    assert not by_sh[:, [0, 2]].any()
    assert by_sh[:, 1].any()


@both
def test_gradient_of_one_pixel_matches_the_formula(backend: str) -> None:
    leaves = leaves_of([[0.0125, 0.0125, 1.0]], opacity=0.6, sigma=0.05)
    with torch.no_grad():
        leaves["quats"][:] = torch.tensor([1.0, 0, 0, 0])
    output = draw(leaves, backend, eps2d=0.0)
    output.alpha[0, 15, 22].backward()
    sigma2 = (40 * 0.05) ** 2
    # The centre projects to pixel (20.5, 15.5), 2 px left of the pixel.
    alpha = 0.6 * math.exp(-0.5 * 4 / sigma2)
    slant = 1 + 0.0125**2
    assert float(output.alpha[0, 15, 22].detach()) == pytest.approx(alpha, rel=2e-3)
    assert float(gradient(leaves, "opacities")[0]) == pytest.approx(alpha / 0.6, rel=2e-3)
    by_x = float(gradient(leaves, "means")[0, 0])
    assert by_x == pytest.approx(alpha * 2 / sigma2 * 40, rel=5e-3)
    by_scale = float(gradient(leaves, "scales")[0, 0])
    assert by_scale == pytest.approx(alpha * 4 / sigma2 / 0.05 / slant, rel=5e-3)


@both
def test_gradients_account_for_quaternion_normalization(backend: str) -> None:
    short, long = leaves_of([[0.3, 0, 3]]), leaves_of([[0.3, 0, 3]])
    for leaves in (short, long):
        leaves["scales"] = torch.tensor([[0.3, 0.1, 0.2]])
    long["quats"] = long["quats"] * 8
    backward(draw(short, backend))
    backward(draw(long, backend))
    assert gradient(short, "quats").any()
    torch.testing.assert_close(gradient(short, "quats"), gradient(long, "quats") * 8)
    along = (gradient(short, "quats") * short["quats"]).sum()
    assert float(along.detach()) == pytest.approx(0, abs=1e-4)


@both
def test_an_empty_image_has_empty_gradients(backend: str) -> None:
    leaves = leaves_of([])
    backward(draw(leaves, backend))
    for part in PARTS:
        assert gradient(leaves, part).shape == leaves[part].shape


@both
def test_a_second_backward_through_a_retained_graph_is_equal(backend: str) -> None:
    leaves = leaves_of([[0.1, 0, 3], [0, 0.2, 4]])
    output = draw(leaves, backend)
    loss = output.rgb.square().sum()
    loss.backward(retain_graph=True)
    first = gradient(leaves, "means").clone()
    leaves["means"].grad = None
    loss.backward()
    assert torch.equal(gradient(leaves, "means"), first)


@both
def test_concurrent_passes_are_independent(backend: str) -> None:
    one, other = leaves_of([[0.1, 0, 3]]), leaves_of([[-0.2, 0.1, 2], [0, 0, 3]])
    first, second = draw(one, backend), draw(other, backend)
    backward(first)
    backward(second)
    alone = leaves_of([[0.1, 0, 3]])
    backward(draw(alone, backend))
    assert torch.equal(gradient(one, "means"), gradient(alone, "means"))


def test_workspaces_are_reused() -> None:
    from real2sim_server.render._cpu.backend import CpuBackend

    backend = CpuBackend()
    for _ in range(4):
        leaves = {name: leaf.requires_grad_() for name, leaf in leaves_of([[0, 0, 3]]).items()}
        cloud = GaussianCloud(*(leaves[part] for part in PARTS))
        output = rasterize([Instance(cloud)], np.eye(4)[None], K, 9, 9, backend=backend)
        output.rgb.sum().backward()
        del output
    assert len(backend._training._idle) == 1


def test_changing_an_input_in_place_before_backward_is_refused() -> None:
    leaves = leaves_of([[0, 0, 3]])
    output = draw(leaves, "cpu")
    with torch.no_grad():
        leaves["means"] += 1
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        backward(output)


def test_intrinsics_that_require_gradients_are_refused() -> None:
    cloud = GaussianCloud(*leaves_of([[0, 0, 3]]).values())
    with pytest.raises(RenderError, match="Ks carry no gradient"):
        rasterize(
            [Instance(cloud)],
            np.eye(4)[None],
            torch.from_numpy(K).requires_grad_(),
            WIDTH,
            HEIGHT,
        )


def test_only_inputs_that_require_gradients_get_them() -> None:
    leaves = leaves_of([[0, 0, 3]])
    pose = torch.eye(4, dtype=torch.float64).requires_grad_()
    cloud = GaussianCloud(*(leaves[part] for part in PARTS))
    output = rasterize([Instance(cloud, pose)], np.eye(4)[None], K, WIDTH, HEIGHT, backend="cpu")
    output.rgb.sum().backward()
    assert pose.grad is not None
    assert pose.grad[:3].any()
    assert all(leaf.grad is None for leaf in leaves.values())


def test_screen_gradients_are_filled_by_backward() -> None:
    leaves = leaves_of([[0.3, 0, 3], [0, 0, -3]])
    output = draw(leaves, "cpu", track_screen=True)
    assert output.screen is not None
    (radii,), (gradients,) = output.screen.radii, output.screen.gradients
    assert radii.shape == (1, 2)
    assert radii[0, 0] > 0
    assert radii[0, 1] == 0
    assert not gradients.any()
    output.alpha[0, 15, 24].backward()
    # With one pixel, the signed and the absolute gradient are equal.
    assert float(gradients[0, 0]) == pytest.approx(float(gradients[0, 1]), rel=1e-4)
    assert not gradients[1].any()
    plain = leaves_of([[0.3, 0, 3], [0, 0, -3]])
    assert draw(plain, "cpu").screen is None


def random_scene(count: int) -> tuple[Leaves, Tensor, Tensor]:
    rng = np.random.default_rng(5)
    parts = (
        rng.uniform((-5, -4, 0.5), (5, 4, 12), (count, 3)),
        rng.normal(size=(count, 4)),
        np.exp(rng.uniform(-5, -2, (count, 3))),
        rng.uniform(0, 1, count),
        rng.normal(0, 0.3, (count, 4, 3)),
    )
    tensors = (torch.from_numpy(part.astype(np.float32)).requires_grad_() for part in parts)
    faces = torch.linspace(0, 1, 6 * 20 * 20 * 3).reshape(6, 20, 20, 3).requires_grad_()
    viewmats = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1).requires_grad_()
    return dict(zip(PARTS, tensors, strict=True)), faces, viewmats


def all_bits(count: int) -> bytes:
    leaves, faces, viewmats = random_scene(count)
    output = rasterize(
        [Instance(GaussianCloud(**leaves))],
        viewmats,
        np.repeat(K * [[[5], [5], [1]]], 2, 0),
        5 * WIDTH,
        5 * HEIGHT,
        sky=Sky(faces),
        options=RasterOptions(track_screen=True),
        backend="cpu",
    )
    backward(output)
    assert output.screen is not None
    grads = [leaf.grad for leaf in (*leaves.values(), faces, viewmats)]
    assert all(grad is not None and grad.any() for grad in grads)
    held = [*grads, *output.screen.gradients, *output.screen.radii]
    return b"".join(tensor.numpy().tobytes() for tensor in held if tensor is not None)


def test_gradients_do_not_depend_on_the_number_of_threads() -> None:
    threads = numba.get_num_threads()
    found = set()
    try:
        for count in range(1, threads + 1):
            numba.set_num_threads(count)
            found.add(all_bits(20_000))
    finally:
        numba.set_num_threads(threads)
    assert len(found) == 1


def test_gradients_do_not_depend_on_earlier_images() -> None:
    first = all_bits(20_000)
    all_bits(3_000)
    assert all_bits(20_000) == first
