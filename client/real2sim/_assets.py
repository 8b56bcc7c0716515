"""The worker's asset library."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from real2sim_proto.assets import AssetCut, AssetInfo, AssetUpload

from . import _requests
from ._call import checked
from ._transport import AsyncTransport, Transport
from .images import Image


class Assets:
    """``client.assets``."""

    def __init__(self, transport: Transport) -> None:
        self._transport = transport

    def list(self) -> Sequence[AssetInfo]:
        """The whole library."""
        return self._transport.send(_requests.list_assets()).assets

    def get(self, asset_id: str) -> AssetInfo:
        """One asset."""
        return self._transport.send(_requests.get_asset(asset_id))

    def cut(
        self,
        *,
        scene: str,
        object_id: str,
        asset_id: str | None = None,
        category: str | None = None,
    ) -> AssetInfo:
        """Cut an object out of a scene; default: under its own id and category."""
        cut = checked(
            AssetCut, scene=scene, object_id=object_id, asset_id=asset_id, category=category
        )
        return self._transport.send(_requests.cut_asset(cut))

    def upload(
        self,
        path: str | os.PathLike[str],
        *,
        asset_id: str | None = None,
        category: str = "car",
        up_axis: str = "-y",
        yaw: float = 0.0,
        length: float | None = None,
    ) -> AssetInfo:
        """Send a splat file (.ply, .compressed.ply, .spz, .splat) to the library.

        Args:
            path: the file.
            asset_id: default: the file's name.
            category: for example ``car``, ``truck``, ``pedestrian``.
            up_axis: axis of the file that points up: ``z``, ``y`` or ``-y``.
            yaw: turn about z after that [rad], to bring the front to x.
            length: real length [m]; default: usual for the category.
        """
        fields = {
            "asset_id": asset_id,
            "category": category,
            "up_axis": up_axis,
            "yaw": yaw,
            "length": length,
        }
        asked = checked(AssetUpload, **fields)
        return self._transport.send(_requests.upload_asset(Path(path), asked))

    def delete(self, asset_id: str) -> None:
        """Remove one that no scenario has in its history."""
        self._transport.send(_requests.delete_asset(asset_id))

    def thumbnail(self, asset_id: str, *, width: int = 256) -> Image:
        """A picture of it (png)."""
        return self._transport.send(_requests.asset_thumbnail(asset_id, width))


class AsyncAssets:
    """``client.assets`` of the async client; see :class:`Assets`."""

    def __init__(self, transport: AsyncTransport) -> None:
        self._transport = transport

    async def list(self) -> Sequence[AssetInfo]:
        """The whole library."""
        return (await self._transport.send(_requests.list_assets())).assets

    async def get(self, asset_id: str) -> AssetInfo:
        """One asset."""
        return await self._transport.send(_requests.get_asset(asset_id))

    async def cut(
        self,
        *,
        scene: str,
        object_id: str,
        asset_id: str | None = None,
        category: str | None = None,
    ) -> AssetInfo:
        """Cut an object out of a scene; default: under its own id and category."""
        cut = checked(
            AssetCut, scene=scene, object_id=object_id, asset_id=asset_id, category=category
        )
        return await self._transport.send(_requests.cut_asset(cut))

    async def upload(
        self,
        path: str | os.PathLike[str],
        *,
        asset_id: str | None = None,
        category: str = "car",
        up_axis: str = "-y",
        yaw: float = 0.0,
        length: float | None = None,
    ) -> AssetInfo:
        """Send a splat file to the library; arguments as of :meth:`Assets.upload`."""
        fields = {
            "asset_id": asset_id,
            "category": category,
            "up_axis": up_axis,
            "yaw": yaw,
            "length": length,
        }
        asked = checked(AssetUpload, **fields)
        return await self._transport.send(_requests.upload_asset(Path(path), asked))

    async def delete(self, asset_id: str) -> None:
        """Remove one that no scenario has in its history."""
        await self._transport.send(_requests.delete_asset(asset_id))

    async def thumbnail(self, asset_id: str, *, width: int = 256) -> Image:
        """A picture of it (png)."""
        return await self._transport.send(_requests.asset_thumbnail(asset_id, width))
