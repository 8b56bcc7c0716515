"""The worker's asset library."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from real2sim_proto.assets import AssetCut, AssetInfo, AssetPerson, AssetUpload

from .. import _requests
from .._call import checked
from .._references import SceneRef, scene_name
from ..images import Image
from .collection import AsyncCollection


class AsyncAssets(AsyncCollection[AssetInfo]):
    """``client.assets``: objects to insert into scenarios.

    Examples:
        >>> client = real2sim.connect_async()
        >>> asset = await client.assets.cut(scene="street", object_id="car_red", asset_id="hatch")
    """

    async def list(self) -> Sequence[AssetInfo]:
        """The whole library.

        Examples:
            >>> [asset.asset_id for asset in await client.assets.list()]
            ['hatch']
        """
        found = await self._transport.send(_requests.list_assets())
        return found.assets

    async def get(self, asset_id: str) -> AssetInfo:
        """One asset.

        Raises:
            NotFoundError: no such asset.

        Examples:
            >>> (await client.assets.get("hatch")).size
            (4.0, 1.8, 1.5)
        """
        return await self._transport.send(_requests.get_asset(asset_id))

    async def cut(
        self,
        *,
        scene: SceneRef,
        object_id: str,
        asset_id: str | None = None,
        category: str | None = None,
    ) -> AssetInfo:
        """Cut an object out of a scene; default: under its own id and category.

        Examples:
            >>> (await client.assets.cut(scene="street", object_id="post")).category
            'pole'
            >>> await client.assets.delete("post")
        """
        cut = checked(
            AssetCut,
            scene=scene_name(scene),
            object_id=object_id,
            asset_id=asset_id,
            category=category,
        )
        return await self._transport.send(_requests.cut_asset(cut))

    async def person(
        self,
        asset_id: str,
        *,
        build: str = "woman",
        height: float | None = None,
        clothes: Mapping[str, tuple[float, float, float]] | None = None,
        worn: Sequence[str] = (),
    ) -> AssetInfo:
        """Make a person who walks wherever a trajectory leads, at its speed.

        Args:
            asset_id: a free id.
            build: for example ``woman``, ``tall_man``, ``old_woman``, ``boy``.
            height: of the person [m]; default: of the build.
            clothes: RGB in [0, 1] of ``skin``, ``hair``, ``top``, ``trousers``, ``shoes``.
            worn: ``long_hair``, ``skirt``.

        Raises:
            ConflictError: the id is taken.

        Examples:
            >>> asset = await client.assets.person("anna", build="woman", height=1.7)
            >>> asset.category, round(asset.size[2], 1)
            ('pedestrian', 1.7)
            >>> await client.assets.delete("anna")
        """
        asked = checked(
            AssetPerson,
            asset_id=asset_id,
            build=build,
            height=height,
            clothes=dict(clothes or {}),
            worn=list(worn),
        )
        return await self._transport.send(_requests.make_person(asked))

    async def upload(
        self,
        path: str | os.PathLike[str],
        *,
        asset_id: str | None = None,
        category: str = "car",
        up_axis: str | None = None,
        yaw: float = 0.0,
        length: float | None = None,
    ) -> AssetInfo:
        """Send a splat file (.ply, .compressed.ply, .spz, .splat) to the library.

        Args:
            path: the file.
            asset_id: default: the file's name.
            category: for example ``car``, ``truck``, ``pedestrian``.
            up_axis: axis of the file that points up: ``z``, ``y`` or ``-y``; default: what the file
                says, as spz and exported ply do, else ``-y``. ``provenance["up_axis"]`` of the
                asset is the one that was taken.
            yaw: turn about z after that [rad], to bring the front to x.
            length: real length [m]; default: usual for the category.

        Examples:
            >>> path = folder / "corner.ply"
            >>> asset = await client.assets.upload(path, up_axis="z", length=4.2)
            >>> asset.asset_id, round(asset.size[0], 3)
            ('corner', 4.2)
            >>> await client.assets.delete("corner")
        """
        fields = {
            "asset_id": asset_id,
            "category": category,
            "up_axis": up_axis,
            "yaw": yaw,
            "length": length,
        }
        upload = checked(AssetUpload, **fields)
        return await self._transport.send(_requests.upload_asset(Path(path), upload))

    async def delete(self, asset_id: str) -> None:
        """Remove one that no scenario has in its history.

        Raises:
            ConflictError: a scenario has it in its history.

        Examples:
            >>> await client.assets.delete("hatch")
        """
        await self._transport.send(_requests.delete_asset(asset_id))

    async def thumbnail(self, asset_id: str, *, width: int = 256) -> Image:
        """A picture of it (png).

        Examples:
            >>> (await client.assets.thumbnail("hatch", width=64)).codec
            'png'
        """
        return await self._transport.send(_requests.asset_thumbnail(asset_id, width))
