"""All trainable Gaussians, packed: background first, then object by object."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ...scene import GaussianCloud, Scene
from ...scene.cloud import TimeColour
from .activation import activated, first_rows

FIELDS = ("means", "log_scales", "quats", "logits", "sh", "fourier")
OBJECT_FIELDS = ("fourier",)
"""Fields that only the Gaussians of objects have."""


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
        """From rows [M] of Gaussians (sorted by owner) to rows of the tensor ``name``."""
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
        """Give all quaternions the length 1, which changes no rotation; those that have it keep
        their bits."""
        length = self.quats.norm(dim=-1, keepdim=True)
        unit = (length - 1).abs() < 1e-6
        self.quats.copy_(torch.where(unit, self.quats, self.quats / length))

    def clouds(
        self, *, degree: int, tones: Tensor | None = None, mirrored: tuple[bool, ...] = ()
    ) -> list[GaussianCloud]:
        """Activated clouds of background and objects; they carry gradients.

        Their quaternions are of any length: every renderer normalises them.

        Args:
            degree: of the spherical harmonics.
            tones: [M, F] basis values by which each object's Fourier part counts; None for none.
            mirrored: objects to be reflected at their x z plane.
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
    """Both together, sorted by owner, and [N] bool: which of them are ``second``'s."""
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
        sh_degree: of the spherical harmonics.
        harmonics: F, basis functions of time-varying colours.
        initial_opacity: upper bound, so that all opacities can still learn.
        device: where they are kept.
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
    """A contiguous float32 copy that requires gradients, on ``device`` or where it was."""
    placed = tensor.detach() if device is None else tensor.detach().to(device)
    return placed.float().clone().contiguous().requires_grad_()
