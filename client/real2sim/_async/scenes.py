"""The scenes of a worker, and its asset library."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Literal

from real2sim_proto.base import Pose
from real2sim_proto.lanes import SceneLanes
from real2sim_proto.scenes import (
    AssetCut,
    AssetInfo,
    AssetPerson,
    AssetUpload,
    SceneInfo,
    SceneState,
)
from real2sim_proto.sessions import FreeCamera, SceneView

from .. import _requests
from .._calls import ViewRequest, checked, instant_us
from .._handles import SceneRef, scene_name
from ..errors import Real2SimError, ReplyTimeoutError
from ..images import Image
from ..observation import View
from .concurrency import sleep
from .transport import AsyncCollection

POLL_SECONDS = 0.2


class AsyncScenes(AsyncCollection[SceneInfo]):
    """``client.scenes``. Methods accept a scene's name or its ``SceneInfo``.

    Examples:
        >>> client = real2sim.connect_async()
    """

    _instead: ClassVar = {
        "create": "`real2sim reconstruct LOG --out scenes/street`, or client.scenes.upload(path)",
        "keys": "[s.scene for s in client.scenes]",
        "names": "[s.scene for s in client.scenes]",
        "preview": "client.scenes.render('street', camera='front')",
    }

    async def list(self) -> Sequence[SceneInfo]:
        """Every available scene, in memory or not.

        Examples:
            >>> [scene.scene for scene in await client.scenes.list()]
            ['street']
        """
        found = await self._transport.send(_requests.list_scenes())
        return found.scenes

    async def get(self, scene: SceneRef) -> SceneInfo:
        """One scene: cameras, objects, time range, extent.

        Raises:
            NotFoundError: no such scene.

        Examples:
            >>> street = await client.scenes.get("street")
            >>> [camera.name for camera in street.cameras], street.end_us
            (['front', 'left'], 2000000)
        """
        return await self._transport.send(_requests.get_scene(scene_name(scene)))

    async def lanes(self, scene: SceneRef) -> SceneLanes:
        """The lanes of a scene: centre lines, neighbours, stop lines, signals, roads.

        Raises:
            NotFoundError: no such scene, or it has no lanes: ``get(scene).lane_count`` is 0.

        Examples:
            >>> street = await client.scenes.get("street")
            >>> street.lane_count and len((await client.scenes.lanes(street)).lanes)
            0
        """
        return await self._transport.send(_requests.scene_lanes(scene_name(scene)))

    async def splats(
        self,
        scene: SceneRef,
        *,
        object_id: str | None = None,
        first: int = 0,
        count: int = 32_768,
        up_axis: str = "y",
    ) -> bytes:
        """Gaussians as an spz file (version 3), sorted by decreasing coverage.

        Args:
            scene: a scene or its name.
            object_id: object, in the frame of its box; default: the background, in the world frame.
            first: number of Gaussians to skip from the start.
            count: maximum number, up to 262144; past the end the file is empty.
            up_axis: axis that points up in the file: ``y`` as in all spz files, ``z`` for the axes
                of the scene, or ``-y``.

        Raises:
            NotFoundError: no such scene or object.

        Examples:
            >>> import gzip
            >>> gzip.decompress(await client.scenes.splats("street", object_id="car_red"))[:4]
            b'NGSP'
        """
        params = {"first": str(first), "count": str(count), "up_axis": up_axis}
        params |= {} if object_id is None else {"object_id": object_id}
        return await self._transport.send(_requests.scene_splats(scene_name(scene), params))

    async def sky(self, scene: SceneRef) -> Image:
        """The cube map of the sky: [R, 6 R, 3] uint8, faces +x -x +y -y +z -z side by side.

        Raises:
            NotFoundError: no such scene, or it has no sky.

        Examples:
            >>> (await client.scenes.sky("street")).array.shape[2]
            3
        """
        return await self._transport.send(_requests.scene_sky(scene_name(scene)))

    async def load(self, scene: SceneRef, *, timeout: float | None = None) -> SceneInfo:
        """Load a scene into the worker's memory and wait until it is resident.

        Raises:
            ReplyTimeoutError: it takes longer than ``timeout`` seconds.
            Real2SimError: the scene cannot be loaded.

        Examples:
            >>> (await client.scenes.load("street")).state.value
            'resident'
        """
        name = scene_name(scene)
        await self._transport.send(_requests.load_scene(name))
        seconds = self._transport.target.long_timeout if timeout is None else timeout
        deadline = time.monotonic() + seconds
        while not _is_resident(info := await self.get(name)):
            if time.monotonic() > deadline:
                raise ReplyTimeoutError(f"scene {name!r} in the worker's memory", seconds)
            await sleep(POLL_SECONDS)
        return info

    async def unload(self, scene: SceneRef) -> None:
        """Unload a scene from memory.

        Raises:
            ConflictError: a session uses it.

        Examples:
            >>> await client.scenes.unload("street")
        """
        await self._transport.send(_requests.unload_scene(scene_name(scene)))

    async def import_path(self, path: str, *, scene: str | None = None) -> SceneInfo:
        """Import a bundle or splat file from the worker's import folder.

        Args:
            path: relative to that folder.
            scene: name of the new scene; default: the file's name.

        Examples:
            >>> (await client.scenes.import_path("corner.ply", scene="corner")).gaussians
            300
        """
        return await self._transport.send(_requests.import_scene(path, scene))

    async def upload(self, path: str | os.PathLike[str], *, scene: str | None = None) -> SceneInfo:
        """Upload a bundle or splat file of this machine to the worker and import it.

        Examples:
            >>> (await client.scenes.upload(folder / "corner.ply", scene="mine")).gaussians
            300
        """
        return await self._transport.send(_requests.upload_scene(Path(path), scene))

    async def render(
        self,
        scene: SceneRef,
        camera: str,
        *,
        t: float | None = None,
        t_us: int | None = None,
        width: int | None = None,
        modality: str = "rgb",
        codec: str = "auto",
    ) -> Image:
        """Render one image of a recorded camera at a time of the recording.

        Args:
            scene: a scene or its name.
            camera: name of one of its cameras.
            t, t_us: time in seconds or in microseconds; default: the start of the recording.
            width: pixels; default: as recorded.
            modality: ``rgb``, ``depth``, ``instance``, ``median_depth``, ``semantic`` or
                ``uncertainty``.
            codec: ``raw``, ``jpeg``, ``png``, or ``auto``: raw on this machine, else jpeg.

        Raises:
            NotFoundError: no such scene or camera.
            ValueError: an unknown codec.

        Examples:
            >>> image = await client.scenes.render("street", camera="front", t_us=1_000_000)
            >>> image.array.shape, image.array.dtype
            ((64, 96, 3), dtype('uint8'))
        """
        codec = self._transport.target.image_codec(codec, modality)
        view = ViewRequest(camera, instant_us(t, t_us), width, modality, codec)
        return await self._transport.send(_requests.render_scene(scene_name(scene), view))

    async def view(
        self,
        scene: SceneRef,
        cameras: Sequence[FreeCamera | Mapping[str, Any]],
        *,
        t: float | None = None,
        t_us: int | None = None,
        objects: Mapping[str, Pose | Mapping[str, Any]] | None = None,
        others: Literal["recorded", "parked", "none"] = "recorded",
    ) -> View:
        """Render one instant from any cameras, with objects at any poses; stores nothing.

        Args:
            scene: a scene or its name.
            cameras: models of ``real2sim_proto.sessions.FreeCamera``, or their fields.
            t, t_us: time for objects without a given pose, in seconds or in microseconds;
                default: the start of the recording.
            objects: poses of box centres in the world by object id.
            others: objects without a given pose: ``recorded`` as at ``t_us``, only those that are
                ``parked``, or ``none``.

        Raises:
            NotFoundError: no such scene or object.
            ValueError: an invalid field.

        Examples:
            >>> street = await client.scenes.get("street")
            >>> behind = {"position": (-8.0, 0.0, 2.0), "quaternion": (0.5, -0.5, 0.5, -0.5)}
            >>> camera = {"name": "behind", "width": 96, "height": 64, "pose": behind}
            >>> there = {"position": (14.0, 0.0, 0.8), "quaternion": (1.0, 0.0, 0.0, 0.0)}
            >>> view = await client.scenes.view(
            ...     "street", [camera | {"K": street.cameras[0].K}], objects={"car_red": there}
            ... )
            >>> view.image("behind").shape
            (64, 96, 3)
        """
        posed = [{"object_id": name, "pose": pose} for name, pose in (objects or {}).items()]
        when = instant_us(t, t_us)
        body = checked(SceneView, cameras=list(cameras), t_us=when, objects=posed, others=others)
        return await self._transport.send(_requests.view_scene(scene_name(scene), body))


def _is_resident(info: SceneInfo) -> bool:
    if info.state is SceneState.BROKEN:
        raise Real2SimError(
            f"scene {info.scene!r} is broken: {info.reason or 'no reason given'}",
            hint="import it again, or look at the worker's log",
        )
    return info.state is SceneState.RESIDENT


# The asset library.


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
        """Create a person that walks along any trajectory, at its speed.

        Args:
            asset_id: an unused id.
            build: body shape, such as ``woman``, ``tall_man``, ``old_woman`` or ``boy``.
            height: height of the person [m]; default: that of the build.
            clothes: RGB in [0, 1] of ``skin``, ``hair``, ``top``, ``trousers``, ``shoes``.
            worn: any of ``long_hair``, ``skirt``.

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
        """Upload a splat file (.ply, .compressed.ply, .spz, .splat) to the library.

        Args:
            path: the file.
            asset_id: default: the file's name.
            category: category, such as ``car``, ``truck`` or ``pedestrian``.
            up_axis: axis of the file that points up: ``z``, ``y`` or ``-y``; default: as declared
                in the file (spz and exported ply), else ``z``. The asset's ``provenance`` has the
                axis, and in ``notes`` what was left out of the file.
            yaw: rotation about z after that [rad], to align the front with x.
            length: real length [m]; default: typical for the category.

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
        """Delete an asset that no scenario's history refers to.

        Raises:
            ConflictError: a scenario's history refers to it.

        Examples:
            >>> await client.assets.delete("hatch")
        """
        await self._transport.send(_requests.delete_asset(asset_id))

    async def thumbnail(self, asset_id: str, *, width: int = 256) -> Image:
        """A picture of the asset (png).

        Examples:
            >>> (await client.assets.thumbnail("hatch", width=64)).codec
            'png'
        """
        return await self._transport.send(_requests.asset_thumbnail(asset_id, width))
