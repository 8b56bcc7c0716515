"""The gsplat 1.5.3 functions used by the project, implemented with the reference rasterizer.

Like gsplat on a GPU, they only accept tensors of the pretended device. They return the results that
the project uses, with gradients. This tests the code around gsplat. gsplat's own arithmetic needs a
GPU.
"""

from __future__ import annotations

import types
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from real2sim_server.render._reference import _blend_image, _jacobian, _Splats
from real2sim_server.render.backend import ALPHA_MIN, ScreenWatch
from real2sim_server.scene.cloud import evaluate_sh

from .pretended import Pretended, held

DOUBLE = torch.float64


class _OnHost(torch.autograd.Function):
    """``function`` on the held values, differentiated by torch."""

    @staticmethod
    def forward(ctx: Any, function: Callable[..., tuple[Tensor, ...]], *given: Tensor) -> Any:
        for tensor in given:
            if not isinstance(tensor, Pretended):
                raise RuntimeError(f"gsplat wants a CUDA tensor, not {tensor.device}")
        with torch.enable_grad():
            ctx.inputs = [held(t).detach().requires_grad_(t.is_floating_point()) for t in given]
            ctx.outputs = function(*ctx.inputs)
        ctx.given = given
        return tuple(Pretended(out.detach()) for out in ctx.outputs)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Any:
        pairs = [
            (out, held(g).to(out.dtype))
            for out, g in zip(ctx.outputs, gradients, strict=True)
            if out.requires_grad and g is not None
        ]
        outputs, given = zip(*pairs, strict=True)
        taken = torch.autograd.grad(outputs, ctx.inputs, given, allow_unused=True)
        for tensor in ctx.given:
            if hasattr(tensor, "watch"):
                tensor.absgrad = Pretended(tensor.watch.absolute.float())
        found = [
            Pretended(torch.zeros_like(i) if g is None else g)
            for i, g in zip(ctx.inputs, taken, strict=True)
        ]
        return (None, *found)


def quat_scale_to_covar_preci(
    quats: Tensor, scales: Tensor, *, compute_covar: bool, compute_preci: bool, triu: bool
) -> tuple[Tensor, None]:
    assert compute_covar
    assert not compute_preci
    assert not triu
    return _OnHost.apply(_covariances, quats, scales)[0], None


def _covariances(quats: Tensor, scales: Tensor) -> tuple[Tensor]:
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1).unbind(-1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    factor = torch.stack([torch.stack(row, -1) for row in rows], -2) * scales[:, None]
    return (factor @ factor.mT,)


def spherical_harmonics(degree: int, directions: Tensor, coefficients: Tensor) -> Tensor:
    functions = (degree + 1) ** 2
    return _OnHost.apply(
        lambda d, c: (evaluate_sh(c[:, :functions], d),), directions, coefficients
    )[0]


def rasterization(
    *, means: Tensor, covars: Tensor, opacities: Tensor, colors: Tensor, viewmats: Tensor,
    Ks: Tensor, width: int, height: int, render_mode: str, packed: bool, absgrad: bool,
    quats: None, scales: None, **options: Any,
) -> tuple[Tensor, Tensor, dict[str, Any]]:  # fmt: skip
    assert packed
    rgb, alpha, metas = [], [], []
    for camera in range(len(viewmats)):
        projected = _OnHost.apply(
            lambda m, c, o, v, k: _project(m, c, o, v, k, (width, height), options),
            means, covars, opacities, viewmats[camera], Ks[camera],
        )  # fmt: skip
        kept = held(projected[-1])
        chosen = Pretended(kept.nonzero()[:, 0])
        means2d, conics, opacity, depths, extents = (t[chosen] for t in projected[:5])
        watch = ScreenWatch(len(held(chosen)))
        means2d.watch = watch
        ids = torch.zeros(len(held(chosen)), dtype=torch.int64)
        picture = _OnHost.apply(
            lambda *s, w=watch, i=ids: _blend(s, i, (width, height), w if absgrad else None),
            means2d, conics, opacity, colors[camera][chosen], depths, extents,
        )  # fmt: skip
        rgb.append(torch.cat([picture[0], picture[2][..., None]], -1))
        alpha.append(picture[1][..., None])
        metas.append({
            "means2d": means2d, "conics": conics, "opacities": opacity, "depths": depths,
            "extents": extents, "gaussian_ids": chosen, "radii": extents.ceil().int(),
            "camera_ids": torch.full_like(chosen, camera),
        })  # fmt: skip
    channels = 4 if "ED" in render_mode else 3
    meta = {k: torch.cat([m[k] for m in metas]) for k in metas[0]}
    if len(metas) == 1:
        meta["means2d"] = metas[0]["means2d"]
    return torch.stack(rgb)[..., :channels], torch.stack(alpha), meta


def _project(
    means: Tensor, covars: Tensor, opacities: Tensor, viewmat: Tensor, K: Tensor,
    size: tuple[int, int], options: dict[str, Any],
) -> tuple[Tensor, ...]:  # fmt: skip
    rotation, offset = viewmat[:3, :3].to(DOUBLE), viewmat[:3, 3].to(DOUBLE)
    K = K.to(DOUBLE)
    seen = means.to(DOUBLE) @ rotation.mT + offset
    inside = (seen[:, 2] >= options["near_plane"]) & (seen[:, 2] <= options["far_plane"])
    z = torch.where(inside, seen[:, 2], 1.0)
    means2d = torch.stack(
        [K[0, 0] * seen[:, 0] / z + K[0, 2], K[1, 1] * seen[:, 1] / z + K[1, 2]], -1
    )
    jacobian = _jacobian(seen, z, K, *size)
    sharp = jacobian @ rotation @ covars.to(DOUBLE) @ rotation.mT @ jacobian.mT
    blurred = sharp + options["eps2d"] * torch.eye(2, dtype=DOUBLE)
    determinant = torch.linalg.det(blurred)
    opacity = opacities.to(DOUBLE)
    if options["rasterize_mode"] == "antialiased":
        ratio = torch.linalg.det(sharp).clamp(min=0) / determinant
        opacity = opacity * ratio.clamp(min=1e-30).sqrt()
    reach = (2 * (opacity.detach() / ALPHA_MIN).clamp(min=1).log()).sqrt()
    extents = reach[:, None] * blurred.detach().diagonal(dim1=-2, dim2=-1).sqrt()
    # gsplat's packed projection drops Gaussians that do not touch the image.
    bounds = torch.tensor(size, dtype=DOUBLE)
    touching = ((means2d + extents > 0) & (means2d - extents < bounds)).all(-1).detach()
    large = (extents.ceil() > options["radius_clip"]).any(-1)
    kept = inside & touching & large & (opacity >= ALPHA_MIN)
    conics = torch.stack([blurred[:, 1, 1], -blurred[:, 0, 1], blurred[:, 0, 0]], -1)
    conics = conics / determinant[:, None]
    floats = (means2d, conics, opacity, seen[:, 2], extents)
    return (*(value.float() for value in floats), kept)


def _blend(
    splats: tuple[Tensor, ...], ids: Tensor, size: tuple[int, int], watch: ScreenWatch | None
) -> tuple[Tensor, ...]:
    means2d, conics, opacity, colors, depths, extents = (t.to(DOUBLE) for t in splats)
    made = _Splats(
        means2d, conics, opacity, colors, depths, depths.detach().float(), extents.detach(), ids,
        torch.zeros(len(ids), 2, dtype=torch.int64),
    )  # fmt: skip
    order = torch.argsort(made.depth_key, stable=True)
    sorted_watch = None if watch is None else _Sorted(watch, order)
    images = _blend_image(made.select(order), *size, sorted_watch)
    rgb, alpha, depth, instance, median = images
    return rgb.float(), alpha.float(), depth.float(), instance, median.float()


class _Sorted(ScreenWatch):
    """Passes sorted splats to an observer of unsorted ones."""

    def __init__(self, watch: ScreenWatch, order: Tensor) -> None:
        self.absolute, self._order = watch.absolute, order

    def gather(self, index: Tensor, dx: Tensor, dy: Tensor) -> None:
        super().gather(self._order[index], dx, dy)


def instance_image(
    meta: dict[str, Any] | None, instance_ids: Tensor, shape: tuple[int, int, int]
) -> Tensor:
    """Replaces the CUDA kernel that traverses gsplat's tile lists."""
    if meta is None:
        return torch.zeros(shape, device=instance_ids.device).to(torch.uint16)
    ids = held(instance_ids)[held(meta["gaussian_ids"])]
    return Pretended(_walked(meta, ids, shape, 3).to(torch.uint16))


def median_depth_image(
    meta: dict[str, Any] | None, shape: tuple[int, int, int], device: torch.device
) -> Tensor:
    """Replaces the same kernel."""
    if meta is None:
        return torch.zeros(shape, device=device)
    ids = torch.zeros_like(held(meta["gaussian_ids"]))
    return Pretended(_walked(meta, ids, shape, 4))


def _walked(meta: dict[str, Any], ids: Tensor, shape: tuple[int, int, int], image: int) -> Tensor:
    cameras = held(meta["camera_ids"])
    names = ("means2d", "conics", "opacities", "colors", "depths", "extents")
    images = []
    for camera in range(shape[0]):
        mine = cameras == camera
        parts = [held(meta.get(n, meta["conics"]))[mine].detach() for n in names]
        images.append(_blend(tuple(parts), ids[mine].long(), (shape[2], shape[1]), None)[image])
    return torch.stack(images)


def module() -> types.ModuleType:
    """A module to install as ``gsplat``."""
    made = types.ModuleType("gsplat")
    for function in (rasterization, spherical_harmonics, quat_scale_to_covar_preci):
        setattr(made, function.__name__, function)
    return made
