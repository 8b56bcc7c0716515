"""Levels of detail of clouds, for who counts their memory and makes them before images need them.

Small images are drawn from them; without any of this, the first small image of a cloud makes its
levels and waits for them.
"""

from __future__ import annotations

from collections.abc import Iterable

from .._numba import is_on_disk, made
from ..scene import Scene
from .backends.base import Backend, BatchBackend
from .backends.cpu.detail.hierarchy import held_bytes, hierarchy_of, known_hierarchy
from .backends.select import select_backend
from .backends.warm_up import small_requests
from .types import SMALL_IMAGE_PIXELS, Detail, Instance

LEVELS_SHARE = 0.8
"""Memory of levels over that of their cloud, a little more than measured."""

SMALL_IMAGE_KERNELS = 5
"""That :func:`warm_up_small_images` makes ready."""


def kernels_of_small_images_on_disk() -> bool:
    """Whether an earlier run left what :func:`warm_up_small_images` compiles longest."""
    from .backends.cpu.detail.draw import draw_images

    return is_on_disk(draw_images)


def warm_up_small_images(backend: str | Backend = "auto") -> None:
    """Compile or load everything that a first small image would wait for, and a first image of a
    cloud of few Gaussians; takes a minute the first time."""
    made.expect(SMALL_IMAGE_KERNELS)
    chosen = select_backend(backend) if isinstance(backend, str) else backend
    for request in small_requests():
        chosen.rasterize(request)


def uses_levels(backend: Backend, width: int, height: int, detail: Detail) -> bool:
    """Whether an image of that size [px] is drawn from levels of detail."""
    small = width * height <= SMALL_IMAGE_PIXELS
    return detail == "auto" and small and isinstance(backend, BatchBackend)


def without_levels(things: Iterable[Instance]) -> list[Instance]:
    """Those whose levels of detail are still to be made."""
    return [
        thing
        for thing in things
        if len(thing.cloud)
        and thing.covars is None
        and known_hierarchy(thing.cloud, thing.colour) is None
    ]


def make_levels(things: Iterable[Instance]) -> None:
    """Make the levels of all things: about a second for a million Gaussians. On any thread."""
    for thing in without_levels(things):
        hierarchy_of(thing.cloud, thing.colour)


def levels_estimate(things: Iterable[Instance]) -> int:
    """Memory that the levels of ``things`` will take [bytes], each cloud counted once."""
    clouds = {(id(t.cloud), id(t.colour)): t for t in things}
    sizes = (
        t.cloud.nbytes + (t.colour.nbytes if t.colour is not None else 0) for t in clouds.values()
    )
    return round(LEVELS_SHARE * sum(sizes))


def levels_bytes() -> int:
    """Memory that the levels of all clouds take that are alive [bytes]."""
    return held_bytes()


def scene_levels_bytes(scene: Scene) -> int:
    """Memory that the levels of a scene's own clouds take [bytes], which leaves with the scene."""
    clouds = [(scene.background, None), *((o.cloud, o.colour) for o in scene.objects.values())]
    known = {known_hierarchy(cloud, colour) for cloud, colour in clouds}
    return sum(hierarchy.nbytes for hierarchy in known if hierarchy is not None)
