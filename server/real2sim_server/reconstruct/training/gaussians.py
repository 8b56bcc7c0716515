"""All trainable Gaussians, packed: raw parameters, activations and owners."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...scene import GaussianCloud, Scene
from ...scene.cloud import TimeColour
from . import kernels

# Activations: raw parameters to scales, opacities and colours, owner by owner.
#
# The CPU kernels take one pass each way, compared with a dozen single-threaded passes in torch.
# :func:`activated_plain` is the reference in plain torch.


class Activated(NamedTuple):
    """Activated parameters of N Gaussians by owner: background first, then object by object.

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
    """Scales, opacities and colours of all owners, with gradients.

    Args:
        log_scales: [N, 3] float32.
        logits: [N] float32 of opacities.
        sh: [N, J, 3] float32.
        fourier: [N - counts[0], F, 3] float32, time-varying part of the objects' constant colour.
        tones: [M, F] float32, weights of each object's Fourier part, without gradient; F of 0
            omits it.
        counts: number of Gaussians of each owner.
        functions: K <= J, number of spherical harmonics to use.
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


# The packed Gaussians: background first, then object by object.

FIELDS = ("means", "log_scales", "quats", "logits", "sh", "fourier")
OBJECT_FIELDS = ("fourier",)
"""Fields of object Gaussians only."""


@dataclass(frozen=True, eq=False)
class Gaussians:
    """Raw parameters of N Gaussians, leaves that require gradients.

    Attributes:
        means: [N, 3] in the frame of their instance [m].
        log_scales: [N, 3].
        quats: [N, 4] wxyz, not normalised.
        logits: [N] of opacities.
        sh: [N, K, 3].
        fourier: [N - counts[0], F, 3], time-varying part of the constant colour of objects.
        counts: Gaussians of the background and of each object.
    """

    means: Tensor
    log_scales: Tensor
    quats: Tensor
    logits: Tensor
    sh: Tensor
    fourier: Tensor
    counts: tuple[int, ...]

    def __len__(self) -> int:
        return int(self.means.shape[0])

    @property
    def starts(self) -> list[int]:
        """First row of each owner, and N."""
        return first_rows(self.counts)

    @property
    def owners(self) -> Tensor:
        """[N] int64: 0 for the background, then 1 + position of the object."""
        device = self.means.device
        return torch.repeat_interleave(
            torch.arange(len(self.counts), device=device),
            torch.tensor(self.counts, device=device),
            output_size=len(self),
        )

    def tensors(self) -> dict[str, Tensor]:
        """Parameters by name."""
        return {name: getattr(self, name) for name in FIELDS}

    def rows(self, name: str, index: Tensor) -> Tensor:
        """Map rows [M] of Gaussians (sorted by owner) to rows of the tensor ``name``."""
        return index[index >= self.counts[0]] - self.counts[0] if name in OBJECT_FIELDS else index

    def select(self, source: Tensor) -> Gaussians:
        """The Gaussians ``source`` [M] int64, which must stay sorted by owner."""
        counts = torch.bincount(self.owners[source], minlength=len(self.counts))
        taken = {
            name: leaf(tensor.detach()[self.rows(name, source)])
            for name, tensor in self.tensors().items()
        }
        return Gaussians(**taken, counts=tuple(counts.tolist()))

    @torch.no_grad()
    def normalise(self) -> None:
        """Normalise all quaternions, which changes no rotation; unit quaternions stay
        bit-identical.
        """
        length = self.quats.norm(dim=-1, keepdim=True)
        unit = (length - 1).abs() < 1e-6
        self.quats.copy_(torch.where(unit, self.quats, self.quats / length))

    def clouds(
        self, *, degree: int, tones: Tensor | None = None, mirrored: tuple[bool, ...] = ()
    ) -> list[GaussianCloud]:
        """Activated clouds of background and objects, with gradients.

        Their quaternions are not normalised: every renderer normalises them.

        Args:
            degree: degree of the spherical harmonics.
            tones: [M, F] basis values, weights of each object's Fourier part; None for none.
            mirrored: objects to reflect at their x z plane.
        """
        if tones is None:
            tones = self.fourier.new_zeros(len(self.counts) - 1, 0)
        drawn = activated(
            self.log_scales,
            self.logits,
            self.sh,
            self.fourier,
            tones=tones,
            counts=self.counts,
            functions=(degree + 1) ** 2,
        )
        placed = (torch.split(part, list(self.counts)) for part in (self.means, self.quats))
        clouds = [GaussianCloud(*columns) for columns in zip(*placed, *drawn, strict=True)]
        for index, flip in enumerate(mirrored):
            if flip:
                clouds[index + 1] = mirror(clouds[index + 1])
        return clouds


def concatenate(first: Gaussians, second: Gaussians) -> tuple[Gaussians, Tensor]:
    """Both together, sorted by owner, and [N] bool: the Gaussians of ``second``."""
    fields = {}
    for name in FIELDS:
        start = 1 if name in OBJECT_FIELDS else 0
        parts = [
            torch.split(g.tensors()[name].detach(), list(g.counts[start:])) for g in (first, second)
        ]
        pieces = [part for pair in zip(*parts, strict=True) for part in pair]
        fields[name] = leaf(torch.cat(pieces) if pieces else first.tensors()[name])
    pairs = list(zip(first.counts, second.counts, strict=True))
    counts = torch.tensor([n for pair in pairs for n in pair])
    of_second = torch.tensor([False, True] * len(pairs)).repeat_interleave(counts)
    of_second = of_second.to(first.means.device)
    return Gaussians(**fields, counts=tuple(a + b for a, b in pairs)), of_second


def mirror(cloud: GaussianCloud) -> GaussianCloud:
    """The cloud reflected at its x z plane, as a vehicle appears from its other side."""
    sign = cloud.means.new_tensor
    k = int(cloud.sh.shape[1])
    return replace(
        cloud,
        means=cloud.means * sign([1.0, -1, 1]),
        quats=cloud.quats * sign([1.0, -1, 1, -1]),
        sh=cloud.sh * sign(MIRROR_SIGNS[:k])[:, None],
    )


MIRROR_SIGNS = (1.0, -1, 1, 1, -1, -1, 1, 1, 1, -1, -1, -1, 1, 1, 1, 1)
"""Sign of each basis function of the spherical harmonics when y changes its sign."""


def from_scene(
    scene: Scene,
    *,
    sh_degree: int,
    harmonics: int,
    initial_opacity: float,
    device: torch.device | str = "cpu",
) -> Gaussians:
    """Raw parameters of a scene.

    Args:
        sh_degree: degree of the spherical harmonics.
        harmonics: F, number of basis functions of time-varying colours.
        initial_opacity: upper bound, so that all opacities can still learn.
        device: device of the parameters.
    """
    clouds = [scene.background, *(o.cloud for o in scene.objects.values())]
    clouds = [c.with_sh_degree(sh_degree) for c in clouds]
    concatenate = GaussianCloud.concatenate(clouds).with_sh_degree(sh_degree)
    counts = tuple(len(c) for c in clouds)
    opacities = concatenate.opacities.clamp(0.01, initial_opacity)
    return Gaussians(
        means=leaf(concatenate.means, device),
        log_scales=leaf(concatenate.scales.log(), device),
        quats=leaf(concatenate.quats, device),
        logits=leaf(torch.logit(opacities), device),
        sh=leaf(concatenate.sh, device),
        fourier=leaf(_fourier(scene, sum(counts) - counts[0], harmonics), device),
        counts=counts,
    )


def _fourier(scene: Scene, rows: int, harmonics: int) -> Tensor:
    fourier = torch.zeros(rows, harmonics, 3)
    start = 0
    for item in scene.objects.values():
        colour: TimeColour | None = item.colour
        stop = start + len(item.cloud)
        if colour is not None:
            kept = min(harmonics, colour.coefficients.shape[1])
            fourier[start:stop, :kept] = colour.coefficients[:, :kept]
        start = stop
    return fourier


def leaf(tensor: Tensor, device: torch.device | str | None = None) -> Tensor:
    """A contiguous float32 copy that requires gradients, on ``device`` or the current one."""
    placed = tensor.detach() if device is None else tensor.detach().to(device)
    return placed.float().clone().contiguous().requires_grad_()
