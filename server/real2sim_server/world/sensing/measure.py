"""Clouds of all LiDARs and radars that are due at an instant."""

from __future__ import annotations

from collections.abc import Sequence

from ...render.cast.types import CastBackend
from ..ranging import Cloud, Mounted, MountedLidar
from ..world import World
from .met import met_things
from .scans import scan_cloud
from .sweeps import sweep_cloud


def clouds_of(world: World, due: Sequence[Mounted], caster: CastBackend) -> list[Cloud]:
    """What ``due`` sensors measure at the instant of ``world``, in their order."""
    things = met_things(world)
    return [
        sweep_cloud(world, mounted, things, caster)
        if isinstance(mounted, MountedLidar)
        else scan_cloud(world, mounted, things, caster)
        for mounted in due
    ]
