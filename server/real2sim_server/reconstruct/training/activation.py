"""From raw parameters of Gaussians to scales, opacities and colours, owner by owner.

Torch would pass over the parameters a dozen times on one thread, forth and back. On the CPU it is
done in one pass each way; :func:`activated_plain` says in plain torch what that computes.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from . import kernels as kernels


class Activated(NamedTuple):
    """What is drawn of N Gaussians, by owner: background first, then object by object.

    Attributes:
        scales: [n, 3] float32 [m].
        opacities: [n] float32.
        sh: [n, K, 3] float32.
    """

    scales: tuple[Tensor, ...]
    opacities: tuple[Tensor, ...]
    sh: tuple[Tensor, ...]


def activated(
    log_scales: Tensor,
    logits: Tensor,
    sh: Tensor,
    fourier: Tensor,
    *,
    tones: Tensor,
    counts: Sequence[int],
    functions: int,
) -> Activated:
    """Scales, opacities and colours of all owners; they carry gradients.

    Args:
        log_scales: [N, 3] float32.
        logits: [N] float32 of opacities.
        sh: [N, J, 3] float32.
        fourier: [N - counts[0], F, 3] float32, time-varying part of the objects' constant colour.
        tones: [M, F] float32, by which each object's Fourier part counts, without gradient; F of 0
            leaves it out.
        counts: Gaussians of each owner.
        functions: K <= J, spherical harmonics that are kept.
    """
    parts = (log_scales, logits, sh, fourier)
    if any(part.device.type != "cpu" for part in parts):
        return activated_plain(*parts, tones=tones, counts=counts, functions=functions)
    packed = _Activate.apply(  # type: ignore[no-untyped-call]
        *parts, tones, tuple(counts), functions
    )
    return Activated(*(torch.split(tensor, list(counts)) for tensor in packed))


def first_rows(counts: Sequence[int]) -> list[int]:
    """First row of each owner of ``counts`` Gaussians, and the number of all."""
    return [0, *itertools.accumulate(counts)]


def activated_plain(
    log_scales: Tensor,
    logits: Tensor,
    sh: Tensor,
    fourier: Tensor,
    *,
    tones: Tensor,
    counts: Sequence[int],
    functions: int,
) -> Activated:
    """:func:`activated` in plain torch, for every device and data type."""
    background, objects = torch.split(sh[:, :functions], [counts[0], len(sh) - counts[0]])
    if tones.shape[1]:
        many = torch.tensor(counts[1:], device=tones.device)
        weights = torch.repeat_interleave(tones, many, dim=0, output_size=len(fourier))
        change = (fourier * weights[..., None]).sum(1)
        objects = torch.cat([objects[:, :1] + change[:, None], objects[:, 1:]], dim=1)
    sizes = list(counts)
    return Activated(
        torch.split(log_scales.exp(), sizes),
        torch.split(logits.sigmoid(), sizes),
        (background, *torch.split(objects, sizes[1:])),
    )


class _Activate(torch.autograd.Function):
    @staticmethod
    def forward(  # noqa: PLR0917 - torch passes a function's arguments one by one
        ctx: Any,
        log_scales: Tensor,
        logits: Tensor,
        sh: Tensor,
        fourier: Tensor,
        tones: Tensor,
        counts: tuple[int, ...],
        functions: int,
    ) -> tuple[Tensor, Tensor, Tensor]:
        scales, opacities = torch.empty_like(log_scales), torch.empty_like(logits)
        colours = sh.new_empty(len(sh), functions, 3)
        starts = np.array(first_rows(counts))
        kernels.activate_rows(
            _array(log_scales),
            _array(logits),
            _array(sh),
            _array(fourier),
            _array(tones),
            starts,
            scales.numpy(),
            opacities.numpy(),
            colours.numpy(),
        )
        ctx.starts, ctx.shapes = starts, (sh.shape, fourier.shape)
        ctx.save_for_backward(scales, opacities, tones)
        return scales, opacities, colours

    @staticmethod
    def backward(ctx: Any, *by_outputs: Tensor) -> tuple[Tensor | None, ...]:
        scales, opacities, tones = ctx.saved_tensors
        by_sh, by_fourier = (tones.new_empty(shape) for shape in ctx.shapes)
        if not tones.shape[1]:
            by_fourier.zero_()
        gradients = (torch.empty_like(scales), torch.empty_like(opacities), by_sh, by_fourier)
        by_scales, by_opacities, by_colours = by_outputs
        by_log_scales, by_logits = gradients[:2]
        kernels.activate_backward(
            _array(by_scales),
            _array(by_opacities),
            _array(by_colours),
            _array(scales),
            _array(opacities),
            _array(tones),
            ctx.starts,
            by_log_scales.numpy(),
            by_logits.numpy(),
            by_sh.numpy(),
            by_fourier.numpy(),
        )
        return (*gradients, None, None, None)


def _array(tensor: Tensor) -> NDArray[np.float32]:
    return tensor.detach().contiguous().numpy()
