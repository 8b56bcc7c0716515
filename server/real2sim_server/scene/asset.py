"""Things to put into scenes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

import torch

from .cloud import GaussianCloud
from .figure import Figure
from .scene import box_size


@dataclass(frozen=True, eq=False)
class Asset:
    """A cluster of Gaussians with a box, ready to be inserted into any scene. Immutable.

    Attributes:
        asset_id: name of the asset, unique where assets are kept.
        category: class of the thing, for example ``car``.
        size: (length, width, height) along the asset's x, y, z [m].
        cloud: Gaussians in the object frame: origin at the box centre, x forward, z up.
        provenance: where it comes from (JSON values only).
        content_hash: SHA-256 of the bundle it was read from or written to; empty before that.
        figure: of a person who walks, whose ``cloud`` is in the rest pose; or None.

    Raises:
        SceneError: when ``size`` is not three positive lengths, or the figure is of another cloud.
    """

    asset_id: str
    category: str
    size: tuple[float, float, float]
    cloud: GaussianCloud
    provenance: Mapping[str, Any] = field(default_factory=dict)
    content_hash: str = ""
    figure: Figure | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "size", box_size(self.size, f"asset {self.asset_id!r}"))
        if self.figure is not None:
            self.figure.check_cloud(self.cloud, f"asset {self.asset_id!r}")
        object.__setattr__(self, "provenance", MappingProxyType(dict(self.provenance)))

    @property
    def nbytes(self) -> int:
        """Memory of the Gaussians [bytes]."""
        return self.cloud.nbytes + (self.figure.nbytes if self.figure else 0)

    def to(self, device: torch.device | str) -> Asset:
        """The asset on another device."""
        return replace(self, cloud=self.cloud.to(device))
