"""The asset library: immutable bundles of objects to insert."""

from __future__ import annotations

import secrets
import shutil
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary, WeakValueDictionary

import numpy as np
import structlog
from numpy.typing import NDArray

from real2sim_proto import ErrorCode
from real2sim_proto.scenes import AssetInfo, AssetUpload

from ...edit.light import Colour, ambient_colour, cast_shadow, relighting_gain, relit
from ...geometry import Float, invert_transform
from ...render import Backend, Instance, RasterOptions, rasterize
from ...scene import Asset, BundleError, Figure, GaussianCloud, Ground, Scene, Trajectory
from ...scene.io import (
    AssetSummary,
    StagingLimits,
    load_asset,
    read_asset_summary,
    save_asset,
    stage_asset,
)
from ..http.responses import ServiceError
from .imports import has_claim, import_errors, put_claim, staging_folder
from .scenes import IdleItem, MemoryBudget, Quota, folder_usage

ASSET_SUFFIX = ".r2a"

DEFAULT_LENGTHS = {
    "car": 4.5,
    "van": 5.2,
    "truck": 8.0,
    "bus": 12.0,
    "motorcycle": 2.1,
    "cyclist": 1.8,
}
"""Typical length by category [m], for files without a unit."""

log = structlog.get_logger(__name__)


class LibraryAsset:
    """An asset as scenarios use it; see :class:`real2sim_server.edit.AssetSource`."""

    def __init__(self, asset: Asset) -> None:
        self.asset = asset
        self._lit: WeakKeyDictionary[Scene, GaussianCloud] = WeakKeyDictionary()
        self._lock = threading.Lock()

    @property
    def nbytes(self) -> int:
        """Memory of the Gaussians, including relit copies for scenes [bytes]."""
        with self._lock:
            clouds = [self.asset.cloud, *self._lit.values()]
        # Relit clouds share all tensors except colours.
        tensors = [t for cloud in clouds for t in cloud.tensors().values()]
        return sum({t.data_ptr(): t.nbytes for t in tensors}.values())

    @property
    def asset_id(self) -> str:
        """Id of the asset in the library."""
        return self.asset.asset_id

    @property
    def category(self) -> str:
        """Category of the asset."""
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
    def figure(self) -> Figure | None:
        """Body model of a walking person; None for rigid assets."""
        return self.asset.figure

    @property
    def content_hash(self) -> str:
        """SHA-256 of its bundle."""
        return self.asset.content_hash

    @property
    def ambient(self) -> Colour | None:
        """Mean colour of the asset's original surroundings."""
        given = self.asset.provenance.get("ambient")
        return tuple(given) if given is not None else None

    def cloud_in(self, scene: Scene) -> GaussianCloud:
        """The asset's Gaussians, relit for ``scene``, on the scene's device."""
        found = self._lit.get(scene)
        if found is None:
            cloud = self.asset.cloud.to(scene.background.device)
            found = relit(cloud, relighting_gain(scene, cloud, self.ambient))
            with self._lock:
                self._lit[scene] = found
        return found


class AssetLibrary:
    """The assets in a folder. Thread-safe; reading and writing are slow.

    The most recently used assets stay in memory while the budget allows. An asset used by a
    scenario stays in memory with the scenario and counts towards the budget.

    Args:
        folder: folder of asset bundles; it need not exist.
        budget: memory budget shared with scenes; without it all assets stay in memory.
    """

    def __init__(self, folder: Path, budget: MemoryBudget | None = None) -> None:
        self.folder = folder
        self._budget = budget or MemoryBudget(sys.maxsize)
        self._budget.add(self)
        self._kept: dict[str, float] = {}
        self._strong: dict[str, LibraryAsset] = {}
        self._alive: WeakValueDictionary[str, LibraryAsset] = WeakValueDictionary()
        self._summaries: dict[str, AssetSummary] = {}
        self._reserved = 0
        self._removing: set[str] = set()
        self._lock = threading.Lock()
        self._loading = threading.Lock()

    def list(self) -> list[AssetInfo]:
        """All assets by id; broken bundles are skipped and logged."""
        names = sorted(
            p.name.removesuffix(ASSET_SUFFIX) for p in self.folder.glob(f"*{ASSET_SUFFIX}")
        )
        found = (self._summary(name) for name in names if not name.startswith("."))
        return [_info(summary) for summary in found if summary is not None]

    def info(self, asset_id: str) -> AssetInfo:
        """The info of an asset. Raises ServiceError: UNKNOWN_ASSET."""
        summary = self._summary(asset_id)
        if summary is None:
            raise _unknown(asset_id)
        return _info(summary)

    def find(self, asset_id: str) -> LibraryAsset | None:
        """The asset with an id, read from disk if it is not in memory.

        Raises:
            ServiceError: OUT_OF_MEMORY.
        """
        if (known := self._in_memory(asset_id)) is not None:
            return known
        # One read at a time: a second request for the same asset finds it in memory.
        with self._loading:
            if (known := self._in_memory(asset_id)) is not None:
                return known
            summary = self._summary(asset_id)
            return self._load(asset_id, summary) if summary is not None else None

    def get(self, asset_id: str) -> LibraryAsset:
        """The asset with an id. Raises ServiceError: UNKNOWN_ASSET, OUT_OF_MEMORY."""
        found = self.find(asset_id)
        if found is None:
            raise _unknown(asset_id)
        return found

    @property
    def held_bytes(self) -> int:
        """Memory of assets that are cached, in use, or being read [bytes]."""
        with self._lock:
            return self._reserved + sum(asset.nbytes for asset in self._alive.values())

    def idle(self) -> Sequence[IdleItem]:
        """Cached assets. Dropping an asset that a scenario uses frees no memory."""
        with self._lock:
            return [
                IdleItem(used_at, self._strong[asset_id].nbytes, partial(self._drop, asset_id))
                for asset_id, used_at in self._kept.items()
            ]

    def add(self, asset: Asset, *, claim: str | None = None) -> AssetInfo:
        """Store an asset; ``claim`` as in :mod:`.imports`.

        Raises:
            ServiceError: ALREADY_EXISTS: assets never change, because scenarios rely on them.
        """
        self.check_free(asset.asset_id)
        with staging_folder(self.folder) as staging:
            save_asset(asset, staging / "bundle")
            return self.adopt(staging / "bundle", asset.asset_id, claim=claim)

    def adopt(self, folder: Path, asset_id: str, *, claim: str | None = None) -> AssetInfo:
        """Move a complete bundle from the library's disk into the library.

        Raises:
            ServiceError: ALREADY_EXISTS.
        """
        put_claim(folder, claim)
        with self._lock:
            self.check_free(asset_id)
            folder.rename(self.bundle(asset_id))
        return self.info(asset_id)

    def made_by(self, claim: str | None, asset_id: str) -> AssetInfo | None:
        """The asset, if the same request has already created it."""
        return self.info(asset_id) if has_claim(self.bundle(asset_id), claim) else None

    def check_free(self, asset_id: str) -> None:
        """Raises ServiceError: ALREADY_EXISTS if the id is taken."""
        if self.bundle(asset_id).exists():
            raise ServiceError(
                ErrorCode.ALREADY_EXISTS,
                f"there is an asset {asset_id!r} already; assets never change",
                hint="give another asset_id",
            )

    @contextmanager
    def removing(self, asset_id: str) -> Iterator[None]:
        """Hide the asset from lookups during the block; it stays on disk until :meth:`remove`.

        Raises:
            ServiceError: UNKNOWN_ASSET, also while it is being removed.
        """
        self.info(asset_id)
        with self._lock:
            self._removing.add(asset_id)
        try:
            yield
        finally:
            with self._lock:
                self._removing.discard(asset_id)

    def remove(self, asset_id: str) -> None:
        """Delete a hidden asset; its id becomes available again."""
        with self._lock:
            # Renamed first: a crash must not leave a partial bundle under its name.
            trash = self.folder / f".removed-{secrets.token_hex(6)}"
            self.bundle(asset_id).rename(trash)
            for known in (self._kept, self._strong, self._alive, self._summaries):
                known.pop(asset_id, None)
        shutil.rmtree(trash, ignore_errors=True)

    def bundle(self, asset_id: str) -> Path:
        """Path of an asset's bundle."""
        return self.folder / f"{asset_id}{ASSET_SUFFIX}"

    # --- inside -----------------------------------------------------------------------------

    def _summary(self, asset_id: str) -> AssetSummary | None:
        with self._lock:
            if asset_id in self._removing:
                return None
            known = self._summaries.get(asset_id)
        folder = self.bundle(asset_id)
        if not folder.is_dir():
            return None
        if known is None:
            try:
                known = read_asset_summary(folder)
            except BundleError as error:
                log.warning("asset broken", asset_id=asset_id, reason=str(error))
                return None
            with self._lock:
                self._summaries[asset_id] = known
        return known

    def _in_memory(self, asset_id: str) -> LibraryAsset | None:
        with self._lock:
            if asset_id in self._removing:
                return None
            known = self._alive.get(asset_id)
            if known is not None:
                self._keep(asset_id, known)
            return known

    def _keep(self, asset_id: str, asset: LibraryAsset) -> None:
        self._strong[asset_id], self._kept[asset_id] = asset, time.monotonic()

    def _load(self, asset_id: str, summary: AssetSummary) -> LibraryAsset | None:
        def reserve() -> None:
            self._reserved = summary.nbytes

        self._budget.make_room(f"asset {asset_id!r}", summary.nbytes, reserve=reserve)
        try:
            loaded = LibraryAsset(load_asset(self.bundle(asset_id)))
            with self._lock:
                self._alive[asset_id] = loaded
                self._keep(asset_id, loaded)
        except BundleError as error:
            log.warning("asset broken", asset_id=asset_id, reason=str(error))
            return None
        finally:
            self._reserved = 0
        return loaded

    def _drop(self, asset_id: str) -> int:
        """Drop an asset from the cache; returns the freed bytes, 0 while others use it."""
        with self._lock:
            asset = self._strong.pop(asset_id, None)
            self._kept.pop(asset_id, None)
            nbytes = asset.nbytes if asset is not None else 0
            # This is the last reference in this function; any other keeps the asset alive.
            asset = None
            return 0 if asset_id in self._alive else nbytes


def _unknown(asset_id: str) -> ServiceError:
    return ServiceError(
        ErrorCode.UNKNOWN_ASSET,
        f"no asset {asset_id!r} in the library",
        hint="GET /v1/assets lists them; POST /v1/assets adds one",
    )


def _info(summary: AssetSummary) -> AssetInfo:
    provenance = dict(summary.provenance)
    return AssetInfo(
        asset_id=summary.asset_id,
        category=summary.category,
        size=summary.size,
        gaussians=summary.gaussians,
        bytes=summary.nbytes,
        content_hash=summary.content_hash,
        ambient=provenance.pop("ambient", None),
        provenance=provenance,
    )


def extract_object(scene: Scene, object_id: str, *, asset_id: str, category: str | None) -> Asset:
    """An object of a scene as an asset, with its original lighting.

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
    cloud = (found.cloud if found.figure is not None else found.cloud_at(middle)).to("cpu")
    named = category or found.category
    return Asset(asset_id, named, found.size, cloud, provenance, figure=found.figure)


def import_asset(
    library: AssetLibrary,
    source: Path,
    upload: AssetUpload,
    *,
    asset_id: str,
    limits: StagingLimits,
    quota: Quota,
    claim: str | None = None,
) -> AssetInfo:
    """Import an asset from a splat file; turn it upright, centre it and scale it to real size.

    Args:
        library: the target library.
        source: the file, in a separate folder on the library's disk, where the bundle is created.
        upload: the request.
        asset_id: id of the asset.
        limits: limits of the process that reads the file.
        quota: quota of the library.
        claim: claim of the request, see :mod:`.imports`.

    Raises:
        ServiceError: IMPORT_FAILED with the reason, PAYLOAD_TOO_LARGE for the file's content,
            ALREADY_EXISTS, QUOTA_EXCEEDED.
    """
    if (made := library.made_by(claim, asset_id)) is not None:
        return made
    library.check_free(asset_id)
    quota.check()
    staged = source.parent / "bundle"
    options = {
        "category": upload.category,
        "up_axis": upload.up_axis,
        "yaw": upload.yaw,
        "length": upload.length or DEFAULT_LENGTHS.get(upload.category),
    }
    with import_errors(source, setting="MAX_ASSET_BYTES"):
        stage_asset(source, staged, asset_id=asset_id, options=options, limits=limits)
    quota.check(added_bytes=folder_usage(staged)[1])
    return library.adopt(staged, asset_id, claim=claim)


# --- Thumbnails ----------------------------------------------------------------------------------

BACKDROP = (0.90, 0.91, 0.93)
FOCAL = 1.6
"""Focal length as a fraction of the image width: a mild telephoto lens, with low distortion."""

VIEW_FROM = (1.0, 0.75, 0.45)
"""Direction of the camera: front left, from above."""


def draw_thumbnail(asset: Asset, *, width: int, backend: Backend) -> NDArray[np.uint8]:
    """RGB uint8 [H, W, 3] of an asset on a light floor, seen from its front left; H = 3/4 W."""
    height = width * 3 // 4
    radius = float(np.linalg.norm(asset.size)) / 2
    K = np.array([[FOCAL * width, 0, width / 2], [0, FOCAL * width, height / 2], [0, 0, 1.0]])
    distance = radius / np.sin(np.arctan(0.5 * height / (FOCAL * width)))
    eye = np.array(VIEW_FROM) / np.linalg.norm(VIEW_FROM) * distance
    floor = Ground.level(-asset.size[2] / 2)
    shadow = cast_shadow(np.eye(4), asset.cloud, (1.0, 1.0, 1.0), asset.size, floor)
    output = rasterize(
        [Instance(_standing(asset)), *([shadow] if shadow else [])],
        invert_transform(_looking_at_origin(eye))[None],
        K[None],
        width,
        height,
        options=RasterOptions(background=BACKDROP, depth=False, instance=False),
        backend=backend,
    )
    rgb = output.rgb[0].clamp(0.0, 1.0).mul(255.0).round()
    pixels: NDArray[np.uint8] = rgb.to("cpu").numpy().astype(np.uint8)
    return pixels


def _standing(asset: Asset) -> GaussianCloud:
    if asset.figure is None:
        return asset.cloud
    place = np.array([[0.0, 0.0, asset.figure.middle]])
    here = Trajectory(np.zeros(1, np.int64), place, np.array([[1.0, 0.0, 0.0, 0.0]]))
    return asset.figure.posed(asset.cloud, here, 0)


def _looking_at_origin(eye: Float) -> Float:
    """``T_world_camera`` [4, 4] at ``eye`` [3], x right, y down, z towards the origin."""
    forward = -eye / np.linalg.norm(eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = eye
    return pose
