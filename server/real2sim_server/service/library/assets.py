"""The asset library: things to insert, each a bundle that never changes."""

from __future__ import annotations

import secrets
import shutil
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import structlog

from real2sim_proto import ErrorCode
from real2sim_proto.assets import AssetInfo, AssetUpload

from ...edit.lighting import Colour, ambient_colour, relighting_gain, relit
from ...scene import Asset, BundleError, GaussianCloud, Scene, SceneError
from ...scene.io import import_splats, load_asset, save_asset
from ..http.problems import ServiceError

ASSET_SUFFIX = ".r2a"

USUAL_LENGTHS = {
    "car": 4.5,
    "van": 5.2,
    "truck": 8.0,
    "bus": 12.0,
    "motorcycle": 2.1,
    "cyclist": 1.8,
}
"""Usual length by category [m], for files that do not say what a unit is."""

log = structlog.get_logger(__name__)


class LibraryAsset:
    """An asset as scenarios use it; see :class:`real2sim_server.edit.AssetSource`."""

    def __init__(self, asset: Asset) -> None:
        self.asset = asset
        self._lit: WeakKeyDictionary[Scene, GaussianCloud] = WeakKeyDictionary()

    @property
    def asset_id(self) -> str:
        """Its name in the library."""
        return self.asset.asset_id

    @property
    def category(self) -> str:
        """Class of the thing."""
        return self.asset.category

    @property
    def size(self) -> tuple[float, float, float]:
        """(length, width, height) [m]."""
        return self.asset.size

    @property
    def gaussians(self) -> int:
        """Number of Gaussians."""
        return len(self.asset.cloud)

    @property
    def content_hash(self) -> str:
        """SHA-256 of its bundle."""
        return self.asset.content_hash

    @property
    def ambient(self) -> Colour | None:
        """Mean colour of where it was cut out."""
        given = self.asset.provenance.get("ambient")
        return tuple(given) if given is not None else None

    def cloud_in(self, scene: Scene) -> GaussianCloud:
        """Its Gaussians in the light of ``scene``, on its device."""
        found = self._lit.get(scene)
        if found is None:
            cloud = self.asset.cloud.to(scene.background.device)
            found = self._lit[scene] = relit(cloud, relighting_gain(scene, cloud, self.ambient))
        return found

    def info(self) -> AssetInfo:
        """What the wire says about it."""
        provenance = {k: v for k, v in self.asset.provenance.items() if k != "ambient"}
        return AssetInfo(
            asset_id=self.asset_id,
            category=self.category,
            size=self.size,
            gaussians=self.gaussians,
            bytes=self.asset.nbytes,
            content_hash=self.content_hash,
            ambient=self.ambient,
            provenance=provenance,
        )


class AssetLibrary:
    """The assets below a folder. Safe to use on any thread; reading and writing take time.

    Args:
        folder: of asset bundles; it need not exist.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._assets: dict[str, LibraryAsset] = {}
        self._removing: set[str] = set()
        self._lock = threading.Lock()

    def list(self) -> list[LibraryAsset]:
        """All assets by id; broken bundles are passed over, with a line in the log."""
        names = sorted(
            p.name.removesuffix(ASSET_SUFFIX) for p in self.folder.glob(f"*{ASSET_SUFFIX}")
        )
        found = (self.find(name) for name in names if not name.startswith("."))
        return [asset for asset in found if asset is not None]

    def find(self, asset_id: str) -> LibraryAsset | None:
        """The asset of that id, read from disk the first time."""
        with self._lock:
            if asset_id in self._removing:
                return None
            known = self._assets.get(asset_id)
            if known is None and self._bundle(asset_id).is_dir():
                try:
                    known = self._assets[asset_id] = LibraryAsset(
                        load_asset(self._bundle(asset_id))
                    )
                except BundleError as error:
                    log.warning("asset broken", asset_id=asset_id, reason=str(error))
            return known

    def get(self, asset_id: str) -> LibraryAsset:
        """The asset of that id. Raises ServiceError: UNKNOWN_ASSET."""
        found = self.find(asset_id)
        if found is None:
            raise ServiceError(
                ErrorCode.UNKNOWN_ASSET,
                f"no asset {asset_id!r} in the library",
                hint="GET /v1/assets lists them; POST /v1/assets adds one",
            )
        return found

    def add(self, asset: Asset) -> LibraryAsset:
        """Keep an asset.

        Raises:
            ServiceError: ALREADY_EXISTS: assets never change, because scenarios rely on them.
        """
        with self._lock:
            target = self._bundle(asset.asset_id)
            if target.exists():
                raise ServiceError(
                    ErrorCode.ALREADY_EXISTS,
                    f"there is an asset {asset.asset_id!r} already; assets never change",
                    hint="give another asset_id",
                )
            self.folder.mkdir(parents=True, exist_ok=True)
            added = self._assets[asset.asset_id] = LibraryAsset(save_asset(asset, target))
            return added

    @contextmanager
    def removing(self, asset_id: str) -> Iterator[None]:
        """Hide the asset from lookups while the block runs; it stays on disk until :meth:`remove`.

        Raises:
            ServiceError: UNKNOWN_ASSET, also while it is being removed.
        """
        self.get(asset_id)
        with self._lock:
            self._removing.add(asset_id)
        try:
            yield
        finally:
            with self._lock:
                self._removing.discard(asset_id)

    def remove(self, asset_id: str) -> None:
        """Delete a hidden asset; its id may be given again."""
        with self._lock:
            # Renamed first: a crash must not leave half a bundle under its name.
            trash = self.folder / f".removed-{secrets.token_hex(6)}"
            self._bundle(asset_id).rename(trash)
            self._assets.pop(asset_id, None)
        shutil.rmtree(trash, ignore_errors=True)

    def _bundle(self, asset_id: str) -> Path:
        return self.folder / f"{asset_id}{ASSET_SUFFIX}"


def extract_object(scene: Scene, object_id: str, *, asset_id: str, category: str | None) -> Asset:
    """An object of a scene as an asset, with the light it was seen in.

    Raises:
        UnknownObjectError: ``scene`` has no such object.
        ServiceError: IMPORT_FAILED for an object without Gaussians.
    """
    found = scene.object(object_id)
    if not len(found.cloud):
        raise ServiceError(
            ErrorCode.IMPORT_FAILED, f"object {object_id!r} has no Gaussians; nothing to cut out"
        )
    middle = (found.trajectory.start_us + found.trajectory.end_us) // 2
    provenance: dict[str, Any] = {
        "source": "cut out of a scene",
        "scene": scene.name,
        "scene_hash": scene.content_hash,
        "object_id": object_id,
        "ambient": list(ambient_colour(scene)),
    }
    cloud = found.cloud_at(middle).to("cpu")
    return Asset(asset_id, category or found.category, found.size, cloud, provenance)


def import_asset(path: Path, upload: AssetUpload, *, asset_id: str) -> Asset:
    """The asset in a splat file, upright, centred and at a real size.

    Raises:
        ServiceError: IMPORT_FAILED, with the reason.
    """
    try:
        raw = import_splats(
            path,
            name=asset_id,
            as_asset=True,
            category=upload.category,
            up_axis=upload.up_axis,
            yaw=upload.yaw,
        )
    except (BundleError, SceneError) as error:
        reason = str(error).replace(f"{path.parent}/", "")
        raise ServiceError(
            ErrorCode.IMPORT_FAILED,
            reason,
            hint="give a splat file: .ply, .compressed.ply, .spz or .splat",
        ) from error
    length = upload.length or USUAL_LENGTHS.get(upload.category, raw.size[0])
    factor = length / raw.size[0]
    x, y, z = (side * factor for side in raw.size)
    cloud = raw.cloud.moved(np.eye(4), scale=factor)
    provenance = dict(raw.provenance) | {"scale": factor}
    return replace(raw, cloud=cloud, size=(x, y, z), provenance=provenance)
