"""What lies on the device from frame to frame: clouds, colours and skies."""

from __future__ import annotations

import weakref

from torch import Tensor

from ....scene import GaussianCloud, Sky, TimeColour
from .launcher import Launcher


class Residence:
    """Addresses on the device. What lies elsewhere is copied there once, and kept while the
    original lives."""

    def __init__(self, launcher: Launcher) -> None:
        self._launcher = launcher
        self._held: weakref.WeakKeyDictionary[object, tuple[tuple[int, ...], list[Tensor]]] = (
            weakref.WeakKeyDictionary()
        )

    def cloud(self, cloud: GaussianCloud) -> tuple[int, ...]:
        """Addresses of means, quats, scales, opacities and harmonics; how many Gaussians, and how
        many harmonics each has."""
        held = self._held.get(cloud)
        if held is not None:
            return held[0]
        parts = (cloud.means, cloud.quats, cloud.scales, cloud.opacities, cloud.sh)
        return self._hold(cloud, parts, (len(cloud), int(cloud.sh.shape[1])))

    def colour(self, colour: TimeColour) -> int:
        """Address of the coefficients."""
        return self._one(colour, colour.coefficients)

    def sky(self, sky: Sky) -> int:
        """Address of the faces."""
        return self._one(sky, sky.faces)

    def _one(self, owner: object, tensor: Tensor) -> int:
        held = self._held.get(owner)
        return (self._hold(owner, (tensor,), ()) if held is None else held[0])[0]

    def _hold(
        self, owner: object, parts: tuple[Tensor, ...], sizes: tuple[int, ...]
    ) -> tuple[int, ...]:
        moved = [part.detach().to(self._launcher.device).contiguous() for part in parts]
        numbers = (*(self._launcher.pointer(tensor) for tensor in moved), *sizes)
        self._held[owner] = (numbers, moved)
        return numbers
