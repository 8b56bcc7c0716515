"""Scenes and assets as bundles: self-contained folders. Format: docs/scene_format.md."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..._confined import ConfinedError, Limits, run_confined
from ...body.gait import GaitStyle
from ..asset import Asset
from ..cloud import GaussianCloud, TimeColour
from ..coverage import Coverage
from ..errors import BundleError, BundleTooLargeError, SceneError
from ..figure import Figure
from ..ground import Ground, of_bundle
from ..lane_graph import LaneGraph
from ..lidar_surfaces import RANGE_STEPS, LidarSurfaces, Reflector, RingResponse
from ..scene import Scene, SceneObject, Sky
from .container import (
    TensorFile,
    cloud_shapes,
    cloud_tensors,
    figure_shapes,
    figure_tensors,
    read_container,
    reflector_shapes,
    reflector_tensors,
    tensor_hashes,
    write_container,
)
from .document import (
    UNCERTAINTIES,
    AssetContent,
    AssetDocument,
    Bounds,
    CameraPart,
    CloudPart,
    ColourPart,
    EgoPart,
    FigurePart,
    GaitPart,
    GroundPart,
    LanesPart,
    LidarPart,
    ObjectPart,
    ReflectorPart,
    ResponsePart,
    SceneContent,
    SceneDocument,
    SkyPart,
    SunlightPart,
    TrajectoryPart,
    pack_lanes,
    unpack_lanes,
)
from .export import INDEX_NAME, import_exported
from .splat_format import UpAxis
from .splats import import_splats

BACKGROUND_FILE = "background.safetensors"
OBJECTS_FILE = "objects.safetensors"
SKY_FILE = "sky.safetensors"
GROUND_FILE = "ground.safetensors"
LIDAR_FILE = "lidar.safetensors"
LANES_FILE = "lanes.safetensors"
ASSET_FILE = "asset.safetensors"

_UNWRITTEN = {"format": "", "version": 0, "content_hash": "0" * 64, "files": {}}


def save_scene(scene: Scene, path: str | PathLike[str], *, overwrite: bool = False) -> Scene:
    """Write ``scene`` as a bundle; return the scene with its content hash and its ground.

    A scene without a stored ground gets its fitted one. Writing is atomic. An existing bundle is
    replaced only with ``overwrite``; other non-empty folders are never touched.

    Args:
        scene: on any device.
        path: folder to write, by convention ``<name>.r2s``.
        overwrite: replace an existing bundle.

    Raises:
        BundleError: ``path`` exists and may not be replaced.
        SceneError: values that are not finite or out of range, provenance that is not JSON.
        OSError: the folder cannot be written.
    """
    background = _outgoing(scene.background, "background")
    objects = [_outgoing(o.cloud, f"object {k!r}") for k, o in scene.objects.items()]
    colours = [_outgoing_colour(o) for o in scene.objects.values()]
    figures = [_outgoing_figure(o.figure, f"object {k!r}") for k, o in scene.objects.items()]
    sky = _outgoing_sky(scene.sky)
    ground = _outgoing_ground(scene.ground)
    lanes, lane_tensors = _outgoing_lanes(scene.lanes)
    content = SceneContent(
        cameras=[CameraPart.of(c) for c in scene.rig],
        ego=EgoPart(size=scene.ego_size, trajectory=TrajectoryPart.of(scene.ego)),
        frame_times_us=scene.frame_times_us.tolist(),
        background=_cloud_part(background),
        objects=[
            _object_part(o, tensors, colour)
            for o, tensors, colour in zip(scene.objects.values(), objects, colours, strict=True)
        ],
        sky=SkyPart(resolution=sky["faces"].shape[1], tensors=tensor_hashes(sky)) if sky else None,
        ground=_ground_part(scene.ground, ground),
        lidar=_lidar_part(scene.lidar),
        lanes=lanes,
        sunlight=SunlightPart.of(scene.sunlight),
    )
    document = SceneDocument(
        kind="scene",
        name=scene.name,
        provenance=_json_values(scene.provenance),
        bounds=_bounds(background["means"]),
        content=content,
        **_UNWRITTEN,
    )
    whole = [a | b | c for a, b, c in zip(objects, colours, figures, strict=True)]
    keyed = {f"{i}.{name}": t for i, part in enumerate(whole) for name, t in part.items()}
    files = {BACKGROUND_FILE: background, OBJECTS_FILE: keyed, GROUND_FILE: ground}
    if sky:
        files[SKY_FILE] = sky
    if scene.lidar is not None:
        files[LIDAR_FILE] = _lidar_tensors(scene.lidar)
    if lane_tensors:
        files[LANES_FILE] = lane_tensors
    written = write_container(document, Path(path), tensors=files, overwrite=overwrite)
    return replace(scene, content_hash=written.content_hash, stored_ground=scene.ground)


def load_scene(
    path: str | PathLike[str], *, device: torch.device | str = "cpu", verify: bool = True
) -> Scene:
    """Read a scene bundle. On the CPU its tensors are memory-mapped.

    Args:
        path: folder of the bundle.
        device: device of the tensors.
        verify: check every hash and every value; without it only shapes, types and file
            sizes are checked.

    Raises:
        BundleError: names the file and the reason: missing, truncated, changed, of another version.
    """
    folder = Path(path)
    document = read_container(folder, SceneDocument, verify=verify)
    content = document.content
    background = _open(folder, BACKGROUND_FILE, document.files, verify)
    objects = _open(folder, OBJECTS_FILE, document.files, verify)
    with _as_bundle_error(folder):
        scene = Scene(
            name=document.name,
            background=_cloud(background, "", content.background, "background"),
            objects=_objects(objects, content.objects),
            sky=_sky(folder, document, verify) if content.sky else None,
            rig=content.build_rig(),
            ego=content.ego.trajectory.build(),
            frame_times_us=np.array(content.frame_times_us, dtype=np.int64),
            ego_size=content.ego.size,
            provenance=document.provenance,
            content_hash=document.content_hash,
            stored_ground=_ground(folder, document, verify),
            lidar=_lidar(folder, document, verify) if content.lidar else None,
            lanes=_lanes(folder, document, verify) if content.lanes else None,
            sunlight=content.sunlight.build() if content.sunlight else None,
        )
    return scene.to(device)


def load_ground(path: str | PathLike[str], content_hash: str) -> Ground:
    """The ground of a scene bundle, without the rest of the scene. Shared with the loaded scene.

    Args:
        path: folder of the bundle.
        content_hash: expected hash of the bundle.

    Raises:
        BundleError: as :func:`load_scene`, or the hash has changed.
    """
    folder = Path(path)
    document = _document_of(folder, content_hash)
    with _as_bundle_error(folder):
        return _ground(folder, document, verify=True)


def load_lanes(path: str | PathLike[str], content_hash: str) -> LaneGraph | None:
    """The lanes of a scene bundle, without the rest of the scene; None without lanes.

    Args:
        path: folder of the bundle.
        content_hash: expected hash of the bundle.

    Raises:
        BundleError: as :func:`load_scene`, or the hash has changed.
    """
    folder = Path(path)
    document = _document_of(folder, content_hash)
    with _as_bundle_error(folder):
        return _lanes(folder, document, verify=True) if document.content.lanes else None


def load_coverage(path: str | PathLike[str], content_hash: str) -> Coverage | None:
    """What images saw of a scene bundle, with memory-mapped Gaussians; None without uncertainties.

    Args:
        path: folder of the bundle.
        content_hash: expected hash of the bundle.

    Raises:
        BundleError: as :func:`load_scene`, or the hash has changed.
    """
    _document_of(Path(path), content_hash)
    return load_scene(path, verify=False).coverage


def _document_of(folder: Path, content_hash: str) -> SceneDocument:
    document = read_container(folder, SceneDocument, verify=False)
    if document.content_hash != content_hash:
        raise BundleError(f"{folder}: another bundle has replaced it; read its summary again")
    return document


def save_asset(asset: Asset, path: str | PathLike[str], *, overwrite: bool = False) -> Asset:
    """Write ``asset`` as a bundle; return the asset with its content hash.

    Arguments and errors are those of :func:`save_scene`.
    """
    cloud = _outgoing(asset.cloud, f"asset {asset.asset_id!r}")
    figure = _outgoing_figure(asset.figure, f"asset {asset.asset_id!r}")
    document = AssetDocument(
        kind="asset",
        name=asset.asset_id,
        provenance=_json_values(asset.provenance),
        content=AssetContent(
            category=asset.category,
            size=asset.size,
            cloud=_cloud_part(cloud),
            figure=_figure_part(asset.figure),
        ),
        **_UNWRITTEN,
    )
    written = write_container(
        document, Path(path), tensors={ASSET_FILE: cloud | figure}, overwrite=overwrite
    )
    return replace(asset, content_hash=written.content_hash)


def load_asset(
    path: str | PathLike[str], *, device: torch.device | str = "cpu", verify: bool = True
) -> Asset:
    """Read an asset bundle. Arguments and errors are those of :func:`load_scene`."""
    folder = Path(path)
    document = read_container(folder, AssetDocument, verify=verify)
    file = _open(folder, ASSET_FILE, document.files, verify)
    with _as_bundle_error(folder):
        asset = Asset(
            asset_id=document.name,
            category=document.content.category,
            size=document.content.size,
            cloud=_cloud(file, "", document.content.cloud, "asset"),
            provenance=document.provenance,
            content_hash=document.content_hash,
            figure=_figure(file, "", document.content.figure, document.content.cloud, "asset"),
        )
    return asset.to(device)


def _outgoing(cloud: GaussianCloud, what: str) -> dict[str, Tensor]:
    cloud.check_values(what)
    return cloud_tensors(cloud)


def _outgoing_colour(scene_object: SceneObject) -> dict[str, Tensor]:
    colour = scene_object.colour
    if colour is None:
        return {}
    if not bool(torch.isfinite(colour.coefficients).all()):
        raise SceneError(f"object {scene_object.object_id!r}: colour holds values not finite")
    return {"fourier": colour.coefficients.detach().cpu().contiguous()}


def _outgoing_figure(figure: Figure | None, what: str) -> dict[str, Tensor]:
    if figure is None:
        return {}
    figure.check_values(what)
    return figure_tensors(figure)


def _outgoing_sky(sky: Sky | None) -> dict[str, Tensor]:
    if sky is None:
        return {}
    sky.check_values()
    return {name: tensor.detach().cpu().contiguous() for name, tensor in sky.tensors().items()}


def _outgoing_ground(ground: Ground) -> dict[str, Tensor]:
    return {
        "heights": torch.from_numpy(ground.heights.copy()),
        "is_ground": torch.from_numpy(ground.is_ground.astype(np.uint8)),
    }


def _outgoing_lanes(lanes: LaneGraph | None) -> tuple[LanesPart | None, dict[str, Tensor]]:
    if lanes is None:
        return None, {}
    document, arrays = pack_lanes(lanes)
    tensors = {name: torch.from_numpy(array) for name, array in arrays.items()}
    counts = {name: len(array) for name, array in arrays.items()}
    return LanesPart(**counts, tensors=tensor_hashes(tensors), document=document), tensors


def _ground_part(ground: Ground, tensors: Mapping[str, Tensor]) -> GroundPart:
    x, y = ground.origin.tolist()
    rows, columns = ground.heights.shape
    return GroundPart(
        origin=(x, y), cell=ground.cell, shape=(rows, columns), tensors=tensor_hashes(tensors)
    )


def _reflectors(lidar: LidarSurfaces) -> list[tuple[str, Reflector]]:
    """Prefixes of the tensors' keys, with their reflectors."""
    objects = enumerate(lidar.objects.values())
    return [("background.", lidar.background), *((f"{i}.", part) for i, part in objects)]


def _lidar_tensors(lidar: LidarSurfaces) -> dict[str, Tensor]:
    keyed: dict[str, Tensor] = {}
    for prefix, reflector in _reflectors(lidar):
        reflector.check_values(f"lidar {prefix[:-1]}")
        keyed |= {prefix + name: t for name, t in reflector_tensors(reflector).items()}
    return keyed


def _lidar_part(lidar: LidarSurfaces | None) -> LidarPart | None:
    if lidar is None:
        return None
    parts = [
        ReflectorPart(gaussians=len(part.cloud), tensors=tensor_hashes(reflector_tensors(part)))
        for _, part in _reflectors(lidar)
    ]
    response = None
    if lidar.response is not None:
        names = ("elevation", "gain", "offset")
        response = ResponsePart(**{n: getattr(lidar.response, n).tolist() for n in names})
    objects = dict(zip(lidar.objects, parts[1:], strict=True))
    return LidarPart(
        background=parts[0], objects=objects, incidence=lidar.incidence, response=response
    )


def _cloud_part(tensors: Mapping[str, Tensor]) -> CloudPart:
    n, coefficients, _ = tensors["sh"].shape
    degree = round(coefficients**0.5) - 1
    return CloudPart(gaussians=n, sh_degree=degree, tensors=tensor_hashes(tensors))


def _object_part(
    scene_object: SceneObject, tensors: Mapping[str, Tensor], colour: Mapping[str, Tensor]
) -> ObjectPart:
    return ObjectPart(
        object_id=scene_object.object_id,
        category=scene_object.category,
        size=scene_object.size,
        trajectory=TrajectoryPart.of(scene_object.trajectory),
        cloud=_cloud_part(tensors),
        colour=_colour_part(scene_object.colour, colour),
        figure=_figure_part(scene_object.figure),
    )


def _colour_part(colour: TimeColour | None, tensors: Mapping[str, Tensor]) -> ColourPart | None:
    if colour is None:
        return None
    return ColourPart(
        harmonics=int(colour.coefficients.shape[1]),
        basis=colour.basis,
        start_us=colour.start_us,
        end_us=colour.end_us,
        tensors=tensor_hashes(tensors),
    )


def _figure_part(figure: Figure | None) -> FigurePart | None:
    if figure is None:
        return None
    return FigurePart(
        shape=list(figure.shape),
        height=figure.height,
        middle=figure.middle,
        style=GaitPart(**asdict(figure.style)),
        tensors=tensor_hashes(figure_tensors(figure)),
    )


def _json_values(provenance: Mapping[str, Any]) -> Any:
    try:
        return json.loads(json.dumps(dict(provenance), allow_nan=False))
    except (TypeError, ValueError) as error:
        raise SceneError(f"provenance must hold JSON values only: {error}") from error


def _bounds(means: Tensor) -> Bounds | None:
    if not len(means):
        return None
    low, high = means.amin(0).tolist(), means.amax(0).tolist()
    return (tuple(low), tuple(high))


def _open(folder: Path, name: str, sizes: Mapping[str, int], verify: bool) -> TensorFile:
    # File names are never read from scene.json, so a bundle cannot point outside its folder.
    if name not in sizes:
        raise BundleError(f"{folder}: scene.json does not list {name!r} under 'files'")
    return TensorFile(folder / name, nbytes=sizes[name], verify=verify)


def _cloud(file: TensorFile, prefix: str, part: CloudPart, what: str) -> GaussianCloud:
    shapes = cloud_shapes(part.gaussians, part.sh_degree, known=part.tensors)
    cloud = GaussianCloud(**file.take(prefix, shapes=shapes, hashes=part.tensors))
    if file.verify:
        cloud.check_values(what)
    return cloud


def _objects(file: TensorFile, parts: list[ObjectPart]) -> dict[str, SceneObject]:
    objects: dict[str, SceneObject] = {}
    for index, part in enumerate(parts):
        if part.object_id in objects:
            raise SceneError(f"object {part.object_id!r} is listed twice")
        objects[part.object_id] = SceneObject(
            object_id=part.object_id,
            category=part.category,
            size=part.size,
            cloud=_cloud(file, f"{index}.", part.cloud, f"object {part.object_id!r}"),
            trajectory=part.trajectory.build(),
            colour=_colour(file, f"{index}.", part),
            figure=_figure(
                file, f"{index}.", part.figure, part.cloud, f"object {part.object_id!r}"
            ),
        )
    return objects


def _colour(file: TensorFile, prefix: str, part: ObjectPart) -> TimeColour | None:
    if part.colour is None:
        return None
    shapes = {"fourier": (part.cloud.gaussians, part.colour.harmonics, 3)}
    coefficients = file.take(prefix, shapes=shapes, hashes=part.colour.tensors)["fourier"]
    if file.verify and not bool(torch.isfinite(coefficients).all()):
        raise SceneError(f"object {part.object_id!r}: colour holds values that are not finite")
    return TimeColour(coefficients, part.colour.basis, part.colour.start_us, part.colour.end_us)


def _figure(
    file: TensorFile, prefix: str, part: FigurePart | None, cloud: CloudPart, what: str
) -> Figure | None:
    if part is None:
        return None
    shapes = figure_shapes(cloud.gaussians)
    dtypes = {"joints": torch.uint8}
    taken = file.take(prefix, shapes=shapes, hashes=part.tensors, dtypes=dtypes)
    style = GaitStyle(**part.style.model_dump())
    figure = Figure(tuple(part.shape), part.height, part.middle, **taken, style=style)
    if file.verify:
        figure.check_values(what)
    return figure


def _sky(folder: Path, document: SceneDocument, verify: bool) -> Sky | None:
    part = document.content.sky
    if part is None:
        return None
    file = _open(folder, SKY_FILE, document.files, verify)
    r = part.resolution
    shapes: dict[str, tuple[int, ...]] = {"faces": (6, r, r, 3)}
    if UNCERTAINTIES in part.tensors:
        shapes[UNCERTAINTIES] = (6, r, r)
    sky = Sky(**file.take("", shapes=shapes, hashes=part.tensors))
    if verify:
        sky.check_values()
    return sky


def _lidar(folder: Path, document: SceneDocument, verify: bool) -> LidarSurfaces:
    part = document.content.lidar
    assert part is not None
    file = _open(folder, LIDAR_FILE, document.files, verify)
    objects = {
        object_id: _reflector(file, f"{index}.", stored, f"lidar of object {object_id!r}")
        for index, (object_id, stored) in enumerate(part.objects.items())
    }
    background = _reflector(file, "background.", part.background, "lidar of the background")
    return LidarSurfaces(background, objects, part.incidence, _response(part.response))


def _lanes(folder: Path, document: SceneDocument, verify: bool) -> LaneGraph:
    part = document.content.lanes
    assert part is not None
    file = _open(folder, LANES_FILE, document.files, verify)
    shapes: dict[str, tuple[int, ...]] = {"points": (part.points, 3), "values": (part.values,)}
    dtypes = dict.fromkeys(shapes, torch.float64)
    taken = file.take("", shapes=shapes, hashes=part.tensors, dtypes=dtypes)
    return unpack_lanes(part.document, {name: tensor.numpy() for name, tensor in taken.items()})


def _response(part: ResponsePart | None) -> RingResponse | None:
    if part is None:
        return None
    steps = len(RANGE_STEPS) - 1
    if any(len(row) != steps for row in (*part.gain, *part.offset)):
        raise SceneError(f"a LiDAR's response has {steps} numbers for each ring")
    shape = (-1, steps)
    tables = [np.array(rows, np.float32).reshape(shape) for rows in (part.gain, part.offset)]
    return RingResponse(np.array(part.elevation, np.float32), *tables)


def _reflector(file: TensorFile, prefix: str, part: ReflectorPart, what: str) -> Reflector:
    shapes = reflector_shapes(part.gaussians, part.tensors)
    taken = file.take(prefix, shapes=shapes, hashes=part.tensors)
    attributes = taken.pop("attributes")
    reflector = Reflector(GaussianCloud(**taken, sh=torch.zeros(part.gaussians, 1, 3)), attributes)
    if file.verify:
        reflector.check_values(what)
    return reflector


def _ground(folder: Path, document: SceneDocument, verify: bool) -> Ground:
    return of_bundle(document.content_hash, lambda: _read_ground(folder, document, verify=verify))


def _read_ground(folder: Path, document: SceneDocument, *, verify: bool) -> Ground:
    part = document.content.ground
    file = _open(folder, GROUND_FILE, document.files, verify)
    taken = file.take(
        "",
        shapes={"heights": part.shape, "is_ground": part.shape},
        hashes=part.tensors,
        dtypes={"is_ground": torch.uint8},
    )
    origin = np.array(part.origin)
    return Ground(origin, part.cell, taken["heights"].numpy(), taken["is_ground"].numpy() != 0)


@contextmanager
def _as_bundle_error(folder: Path) -> Iterator[None]:
    """Add the name of the bundle to errors about its content."""
    try:
        yield
    except BundleError:
        raise
    except (SceneError, OverflowError) as error:
        raise BundleError(f"{folder}: {error}") from error


# --- Imports in a confined process ----------------------------------------------------------------

# An untrusted file becomes a checked bundle. :func:`stage_scene` and :func:`stage_asset` run the
# functions below in a confined process; the bundle then only needs renaming to its final path.

MIB = 1024**2
LOADED_EARLY = ("cv2", "scipy.ndimage", "scipy.spatial")
"""Modules that the starter of confined processes loads first: the ground fit needs them."""


@dataclass(frozen=True)
class StagingLimits:
    """Limits of one import.

    Attributes:
        max_bytes: memory of the resulting Gaussians.
        memory_bytes: memory of the reading process, including mapped files.
        seconds: duration of one import.
    """

    max_bytes: int
    memory_bytes: int
    seconds: float


class StagingError(SceneError):
    """The bundle cannot be written; the message is the operating system's error."""


def stage_scene(source: Path, folder: Path, *, name: str, limits: StagingLimits) -> None:
    """Read a bundle, splat file or exported folder and write it as a new bundle at ``folder``.

    Raises:
        BundleTooLargeError: it takes more memory than the limits allow.
        BundleError: it cannot be read, or took too long.
        SceneError: the values are not a valid scene, or the bundle cannot be written.
    """
    _staged("read_and_save_scene", source, folder, limits, {"name": name})


def stage_asset(
    source: Path, folder: Path, *, asset_id: str, options: Mapping[str, Any], limits: StagingLimits
) -> None:
    """Read a splat file and write it as a new asset bundle at ``folder``.

    Args:
        source: the splat file.
        folder: folder of the bundle; its parent exists.
        asset_id: name of the asset.
        options: ``category``, ``up_axis`` and ``yaw`` as for :func:`~.splats.import_splats`, and
            ``length`` [m], None for the length in the file.
        limits: limits of the import.

    Raises:
        BundleTooLargeError, BundleError, SceneError: as :func:`stage_scene`.
    """
    _staged("read_and_save_asset", source, folder, limits, {"asset_id": asset_id, **options})


def _staged(
    function: str, source: Path, folder: Path, limits: StagingLimits, options: dict[str, Any]
) -> None:
    places = {"source": str(source.absolute()), "folder": str(folder.absolute())}
    try:
        run_confined(
            f"{__name__}:{function}",
            places | {"max_bytes": limits.max_bytes} | options,
            limits=Limits(
                memory_bytes=limits.memory_bytes,
                seconds=limits.seconds,
                written_bytes=2 * limits.max_bytes + 64 * MIB,
            ),
            errors=(BundleTooLargeError, BundleError, SceneError, StagingError),
        )
    except ConfinedError as error:
        kind = BundleTooLargeError if error.out_of_memory else BundleError
        raise kind(f"{source}: reading it {error}") from error


def read_and_save_scene(source: str, folder: str, *, max_bytes: int, name: str) -> None:
    """The confined part of :func:`stage_scene`."""
    file = Path(source)
    if (file / INDEX_NAME).is_file():
        scene = import_exported(file, name=name, max_bytes=max_bytes)
    elif file.is_dir():
        scene = load_scene(file)
    else:
        scene = import_splats(file, name=name, max_bytes=max_bytes)
    if scene.nbytes > max_bytes:
        raise BundleTooLargeError(
            f"{source}: the scene takes {scene.nbytes} bytes of memory; allowed are {max_bytes}"
        )
    try:
        save_scene(scene, folder)
    except OSError as error:
        raise StagingError(error.strerror or str(error)) from error


def read_and_save_asset(
    source: str,
    folder: str,
    *,
    max_bytes: int,
    asset_id: str,
    category: str,
    up_axis: UpAxis | None,
    yaw: float,
    length: float | None,
) -> None:
    """The confined part of :func:`stage_asset`."""
    raw = import_splats(
        Path(source),
        name=asset_id,
        as_asset=True,
        category=category,
        up_axis=up_axis,
        yaw=yaw,
        max_bytes=max_bytes,
    )
    factor = (length or raw.size[0]) / raw.size[0]
    x, y, z = (side * factor for side in raw.size)
    cloud = raw.cloud.moved(np.eye(4), scale=factor)
    provenance = dict(raw.provenance) | {"scale": factor}
    asset = replace(raw, cloud=cloud, size=(x, y, z), provenance=provenance)
    try:
        save_asset(asset, folder)
    except OSError as error:
        raise StagingError(error.strerror or str(error)) from error
