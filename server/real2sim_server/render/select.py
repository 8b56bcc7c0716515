"""Selection of a backend, and preparation of levels of detail.

Small images are drawn from levels of detail. Without preparation, the first small image of a cloud
waits until its levels are built.
"""

from __future__ import annotations

import functools
import importlib.util
import logging
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import torch

from .._numba import is_on_disk, made
from ..scene import Scene
from ._cpu.detail_levels import held_bytes, hierarchy_of, known_hierarchy
from .backend import Backend, BatchBackend, small_requests
from .types import SMALL_IMAGE_PIXELS, Detail, Instance, RenderError

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class BackendStatus:
    """Whether a backend can be used here.

    Attributes:
        name: name of the backend.
        usable: whether select_backend() would return it.
        reason: why it is usable, or not.
        remedy: how to make it usable; empty if it is.
    """

    name: str
    usable: bool
    reason: str
    remedy: str = ""


@dataclass(frozen=True)
class RegisteredBackend:
    """A backend that can be selected by name.

    Attributes:
        status: function that returns the BackendStatus; must be fast.
        make: function that creates the backend; called once, and only if it is usable.
        preference: ``auto`` selects the usable backend with the highest value; 0 is never selected.
    """

    status: Callable[[], BackendStatus]
    make: Callable[[], Backend]
    preference: int = 0


def register_backend(backend: RegisteredBackend) -> None:
    """Register a third-party backend.

    Raises:
        ValueError: the name is taken.
    """
    name = backend.status().name
    if name in BACKENDS or name == "auto":
        raise ValueError(f"a backend {name!r} is registered already")
    BACKENDS[name] = backend


@functools.cache
def select_backend(name: str = "auto") -> Backend:
    """Return the backend with a name, created on first use.

    Args:
        name: name of a registered backend (``cpu``, ``cuda``, ``nvrtc``, ``reference``), or
            ``auto``: cuda if usable, else cpu.

    Raises:
        RenderError: unknown or unusable backend; the message suggests a fix.
    """
    if name == "auto":
        return select_backend(_preferred())
    if name not in BACKENDS:
        raise RenderError(f"unknown backend {name!r}; allowed are 'auto' and {sorted(BACKENDS)}")
    status = BACKENDS[name].status()
    if not status.usable:
        raise RenderError(f"backend {name!r} is not usable: {status.reason}; {status.remedy}")
    return BACKENDS[name].make()


def describe_backends() -> list[BackendStatus]:
    """Status of every backend, best first."""
    return [backend.status() for backend in _by_preference()]


def _by_preference() -> list[RegisteredBackend]:
    return sorted(BACKENDS.values(), key=lambda backend: -backend.preference)


def _preferred() -> str:
    """Name of the best usable backend; logs why a preferred one is not usable.

    Logs a warning if there is a GPU, because users expect it to be used.
    """
    statuses = [backend.status() for backend in _by_preference() if backend.preference]
    chosen = next((status for status in statuses if status.usable), statuses[-1])
    level, why = logging.INFO, statuses[0].reason
    if not statuses[0].usable:
        why = f"{why}; {statuses[0].remedy}"
        level = logging.WARNING if torch.cuda.is_available() else logging.INFO
    _log.log(level, "render backend %s chosen: %s", chosen.name, why)
    return chosen.name


def _cpu_status() -> BackendStatus:
    if importlib.util.find_spec("numba") is None:
        return BackendStatus(
            "cpu", False, "numba is not installed", "pip install 'real2sim[server]'"
        )
    import numba

    return BackendStatus(
        "cpu", True, f"numba {numba.__version__}, {numba.get_num_threads()} threads"
    )


def _cuda_status() -> BackendStatus:
    from ._cuda.needs import unmet_gsplat_need

    need = unmet_gsplat_need()
    if need is not None:
        return BackendStatus("cuda", False, need.found, need.remedy)
    return BackendStatus("cuda", True, f"gsplat on {torch.cuda.get_device_name()}")


def _nvrtc_status() -> BackendStatus:
    from ._cuda.needs import unmet_nvrtc_need

    need = unmet_nvrtc_need()
    if need is not None:
        return BackendStatus("nvrtc", False, need.found, need.remedy)
    return BackendStatus("nvrtc", True, f"kernels of our own on {torch.cuda.get_device_name()}")


def _make_cpu() -> Backend:
    from ._cpu.backend import CpuBackend

    return CpuBackend()


def _make_cuda() -> Backend:
    from ._cuda.gsplat import CudaBackend

    return CudaBackend()


def _make_nvrtc() -> Backend:
    from ._cuda.serving import NvrtcBackend

    return NvrtcBackend()


def _make_reference() -> Backend:
    from ._reference import ReferenceBackend

    return ReferenceBackend()


BACKENDS: dict[str, RegisteredBackend] = {
    "cuda": RegisteredBackend(_cuda_status, _make_cuda, preference=2),
    "cpu": RegisteredBackend(_cpu_status, _make_cpu, preference=1),
    # Never selected by ``auto``: it has no gradients, so it cannot be used for training.
    "nvrtc": RegisteredBackend(_nvrtc_status, _make_nvrtc),
    "reference": RegisteredBackend(
        lambda: BackendStatus("reference", True, "plain torch, slow"), _make_reference
    ),
}
"""Backends by name. Their modules are imported on creation, because each needs different
libraries."""


# Levels of detail

LEVELS_SHARE = 0.8
"""Memory of levels relative to that of their cloud; an upper estimate."""

SMALL_IMAGE_KERNELS = 5
"""Number of kernels that :func:`warm_up_small_images` compiles."""


def kernels_of_small_images_on_disk() -> bool:
    """Whether the disk cache has the slowest kernels of :func:`warm_up_small_images`."""
    from ._cpu.small_images import draw_images

    return is_on_disk(draw_images)


def warm_up_small_images(backend: str | Backend = "auto") -> None:
    """Compile or load everything for small images and clouds of few Gaussians.

    Takes a minute the first time.
    """
    made.expect(SMALL_IMAGE_KERNELS)
    chosen = select_backend(backend) if isinstance(backend, str) else backend
    for request in small_requests():
        chosen.rasterize(request)


def uses_levels(backend: Backend, width: int, height: int, detail: Detail) -> bool:
    """Whether an image of that size [px] is drawn from levels of detail."""
    small = width * height <= SMALL_IMAGE_PIXELS
    return detail == "auto" and small and isinstance(backend, BatchBackend)


def without_levels(things: Iterable[Instance]) -> list[Instance]:
    """Instances whose levels of detail do not exist yet."""
    return [
        thing
        for thing in things
        if len(thing.cloud)
        and thing.covars is None
        and known_hierarchy(thing.cloud, thing.colour) is None
    ]


def make_levels(things: Iterable[Instance]) -> None:
    """Build the levels of all instances: about a second per million Gaussians. Thread-safe."""
    for thing in without_levels(things):
        hierarchy_of(thing.cloud, thing.colour)


def levels_estimate(things: Iterable[Instance]) -> int:
    """Estimated memory of the levels of all instances [bytes], counting each cloud once."""
    clouds = {(id(t.cloud), id(t.colour)): t for t in things}
    sizes = (
        t.cloud.nbytes + (t.colour.nbytes if t.colour is not None else 0) for t in clouds.values()
    )
    return round(LEVELS_SHARE * sum(sizes))


def levels_bytes() -> int:
    """Memory of the levels of all live clouds [bytes]."""
    return held_bytes()


def scene_levels_bytes(scene: Scene) -> int:
    """Memory of the levels of a scene's clouds [bytes], released with the scene."""
    clouds = [(scene.background, None), *((o.cloud, o.colour) for o in scene.objects.values())]
    known = {known_hierarchy(cloud, colour) for cloud, colour in clouds}
    return sum(hierarchy.nbytes for hierarchy in known if hierarchy is not None)
