"""Scenes of a worker."""

from __future__ import annotations

import asyncio
import os
import time
from collections.abc import Sequence
from pathlib import Path

from real2sim_proto.scenes import SceneInfo, SceneState

from . import _requests
from ._call import ViewRequest
from ._transport import AsyncTransport, Target, Transport
from .errors import Real2SimError, ReplyTimeoutError
from .images import Image

POLL_SECONDS = 0.2


def image_codec(target: Target, codec: str, modality: str) -> str:
    """'auto' made concrete; only rgb has a lossy codec."""
    if codec == "auto" and modality != "rgb":
        return "raw"
    return target.codec(codec)


class Scenes:
    """``client.scenes``."""

    def __init__(self, transport: Transport) -> None:
        self._transport = transport

    def list(self) -> Sequence[SceneInfo]:
        """Every available scene, in memory or not."""
        return self._transport.send(_requests.list_scenes()).scenes

    def get(self, scene: str) -> SceneInfo:
        """One scene: cameras, objects, time range, extent."""
        return self._transport.send(_requests.get_scene(scene))

    def load(self, scene: str, *, timeout: float | None = None) -> SceneInfo:
        """Bring a scene into the worker's memory and wait until it is there."""
        self._transport.send(_requests.load_scene(scene))
        seconds = self._transport.target.patience if timeout is None else timeout
        deadline = time.monotonic() + seconds
        while not _is_resident(info := self.get(scene)):
            if time.monotonic() > deadline:
                raise ReplyTimeoutError(f"scene {scene!r} in the worker's memory", seconds)
            time.sleep(POLL_SECONDS)
        return info

    def unload(self, scene: str) -> None:
        """Free the memory of a scene that no session uses."""
        self._transport.send(_requests.unload_scene(scene))

    def import_path(self, path: str, *, scene: str | None = None) -> SceneInfo:
        """Import a bundle or splat file that lies below the worker's import folder."""
        return self._transport.send(_requests.import_scene(path, scene))

    def upload(self, path: str | os.PathLike[str], *, scene: str | None = None) -> SceneInfo:
        """Send a bundle or splat file of this machine to the worker and import it there."""
        return self._transport.send(_requests.upload_scene(Path(path), scene))

    def render(
        self,
        scene: str,
        *,
        camera: str,
        t_us: int | None = None,
        width: int | None = None,
        modality: str = "rgb",
        codec: str = "auto",
    ) -> Image:
        """One image of a recorded camera at an instant of the recording.

        Args:
            scene: name of the scene.
            camera: name of one of its cameras.
            t_us: instant; default: the start of the recording.
            width: pixels; default: as recorded.
            modality: ``rgb``, ``depth`` or ``instance``.
            codec: ``raw``, ``jpeg``, ``png``, or ``auto``: raw on this machine, else jpeg.
        """
        codec = image_codec(self._transport.target, codec, modality)
        view = ViewRequest(camera, t_us, width, modality, codec)
        return self._transport.send(_requests.render_scene(scene, view))


class AsyncScenes:
    """``client.scenes`` of the async client; see :class:`Scenes`."""

    def __init__(self, transport: AsyncTransport) -> None:
        self._transport = transport

    async def list(self) -> Sequence[SceneInfo]:
        """Every available scene, in memory or not."""
        return (await self._transport.send(_requests.list_scenes())).scenes

    async def get(self, scene: str) -> SceneInfo:
        """One scene: cameras, objects, time range, extent."""
        return await self._transport.send(_requests.get_scene(scene))

    async def load(self, scene: str, *, timeout: float | None = None) -> SceneInfo:
        """Bring a scene into the worker's memory and wait until it is there."""
        await self._transport.send(_requests.load_scene(scene))
        seconds = self._transport.target.patience if timeout is None else timeout
        deadline = time.monotonic() + seconds
        while not _is_resident(info := await self.get(scene)):
            if time.monotonic() > deadline:
                raise ReplyTimeoutError(f"scene {scene!r} in the worker's memory", seconds)
            await asyncio.sleep(POLL_SECONDS)
        return info

    async def unload(self, scene: str) -> None:
        """Free the memory of a scene that no session uses."""
        await self._transport.send(_requests.unload_scene(scene))

    async def import_path(self, path: str, *, scene: str | None = None) -> SceneInfo:
        """Import a bundle or splat file that lies below the worker's import folder."""
        return await self._transport.send(_requests.import_scene(path, scene))

    async def upload(self, path: str | os.PathLike[str], *, scene: str | None = None) -> SceneInfo:
        """Send a bundle or splat file of this machine to the worker and import it there."""
        return await self._transport.send(_requests.upload_scene(Path(path), scene))

    async def render(
        self,
        scene: str,
        *,
        camera: str,
        t_us: int | None = None,
        width: int | None = None,
        modality: str = "rgb",
        codec: str = "auto",
    ) -> Image:
        """One image of a recorded camera; arguments as of :meth:`Scenes.render`."""
        codec = image_codec(self._transport.target, codec, modality)
        view = ViewRequest(camera, t_us, width, modality, codec)
        return await self._transport.send(_requests.render_scene(scene, view))


def _is_resident(info: SceneInfo) -> bool:
    if info.state is SceneState.BROKEN:
        raise Real2SimError(
            f"scene {info.scene!r} is broken: {info.reason or 'no reason given'}",
            hint="import it again, or look at the worker's log",
        )
    return info.state is SceneState.RESIDENT
