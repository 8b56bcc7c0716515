"""Packed scenes: one small file for transfer, about a third of the size of a bundle.

A bundle is memory-mapped and exact. A packed scene is transferred and read once, for example the
street of the demo. Splat files of other programs contain no tracks, cameras, sky or provenance.

A packed scene is quantised: centres to 1/65535 of their cloud's extent, axes to 1/3276 of a power
of e, rotations to 1/127, opacities to 1/255, colours to half precision and the rest of the
spherical harmonics to 1/127 of their largest, heights of the ground to a millimetre. To work with
it, unpack it into a bundle. Format: docs/scene_format.md.
"""

from __future__ import annotations

import io
import json
import tempfile
import zipfile
from dataclasses import asdict
from os import PathLike
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from torch import Tensor

from ..._files import atomic_file
from ..._npy import read_entries, read_npy
from ...body.gait import GaitStyle
from ..camera import CameraRig
from ..cloud import GaussianCloud, TimeColour
from ..errors import BundleError
from ..figure import Figure
from ..ground import Ground
from ..scene import Scene, SceneObject, Sky
from .bundle import load_scene, save_scene
from .document import UNCERTAINTIES, CameraPart, GaitPart, SunlightPart, TrajectoryPart

FORMAT, VERSION = "real2sim-packed", 1
DOCUMENT = "scene.json"
MAX_BYTES = 1 << 32
"""Maximum total size of the unpacked arrays, as protection from decompression bombs."""
MEAN_STEPS, QUAT_STEPS, OPACITY_STEPS, SH_STEPS = 65535, 127, 255, 127
UNCERTAINTY_STEPS = 255
"""Quantisation steps of the square roots of uncertainties."""
HEIGHT_STEP = 0.001
"""Quantisation of the ground [m]."""
LOG_SCALE_STEPS, LOWEST_LOG_SCALE = 3276, -13.0
"""Quantisation of an axis: 16 bits from 2 micrometres to a kilometre."""

SKY_UNCERTAINTIES = f"sky.{UNCERTAINTIES}"

Arrays = dict[str, NDArray[Any]]
Vector3 = tuple[float, float, float]


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


class _PackedCloud(_Part):
    low: Vector3
    extent: Vector3
    sh_range: Annotated[float, Field(ge=0)]


class _PackedColour(_Part):
    basis: Literal["cosine", "real_dft"]
    start_us: int
    end_us: int


class _PackedFigure(_Part):
    shape: list[float]
    height: float
    middle: float
    style: GaitPart


class _PackedObject(_Part):
    object_id: str
    category: str
    size: Vector3
    trajectory: TrajectoryPart
    cloud: _PackedCloud
    colour: _PackedColour | None
    figure: _PackedFigure | None


class _PackedGround(_Part):
    origin: tuple[float, float]
    cell: Annotated[float, Field(gt=0)]


class _PackedDocument(_Part):
    format: str
    version: int
    name: str
    cameras: list[CameraPart]
    ego: TrajectoryPart
    ego_size: Vector3
    frame_times_us: list[int]
    background: _PackedCloud
    objects: list[_PackedObject]
    ground: _PackedGround
    sunlight: SunlightPart | None = None
    provenance: dict[str, Any]


def write_packed(scene: Scene, path: str | PathLike[str]) -> None:
    """Write ``scene`` to the file ``path`` atomically, by convention ``<name>.r2s.zip``.

    Leaves out LiDAR surfaces: LiDAR of the packed scene uses the Gaussians trained on images.

    Raises:
        SceneError: values that are not finite or out of range.
        OSError: the file cannot be written.
    """
    arrays: Arrays = {}
    document = _PackedDocument(
        format=FORMAT,
        version=VERSION,
        name=scene.name,
        cameras=[CameraPart.of(camera) for camera in scene.rig],
        ego=TrajectoryPart.of(scene.ego),
        ego_size=scene.ego_size,
        frame_times_us=scene.frame_times_us.tolist(),
        background=_pack_cloud(scene.background, "background", arrays),
        objects=[_pack_object(o, f"{i}", arrays) for i, o in enumerate(scene.objects.values())],
        ground=_pack_ground(scene.ground, arrays),
        sunlight=SunlightPart.of(scene.sunlight),
        provenance=json.loads(json.dumps(dict(scene.provenance), allow_nan=False)),
    )
    if scene.sky is not None:
        faces = (scene.sky.faces.detach().cpu().clamp(0, 1) * 255).round()
        arrays["sky"] = faces.to(torch.uint8).numpy()
        if scene.sky.uncertainties is not None:
            arrays[SKY_UNCERTAINTIES] = _root_steps(scene.sky.uncertainties.detach())
    with (
        atomic_file(Path(path)) as file,
        zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive,
    ):
        _put(archive, DOCUMENT, document.model_dump_json().encode())
        for name, array in arrays.items():
            data = io.BytesIO()
            np.save(data, array, allow_pickle=False)
            _put(archive, f"{name}.npy", data.getvalue())


def read_packed(path: str | PathLike[str]) -> Scene:
    """Read a packed scene.

    Raises:
        BundleError: names the file and the reason: missing, truncated, of another version.
    """
    file = Path(path)
    try:
        with zipfile.ZipFile(file) as archive:
            parts = read_entries(archive, max_bytes=MAX_BYTES)
        document = _document(parts[DOCUMENT], file)
        arrays = {n[:-4]: read_npy(data) for n, data in parts.items() if n.endswith(".npy")}
        return _scene(document, arrays)
    except BundleError:
        raise
    except FileNotFoundError as error:
        raise BundleError(f"{file}: there is no such file") from error
    # A damaged file can raise almost any error.
    except Exception as error:
        reason = str(error) or type(error).__name__
        raise BundleError(f"{file}: not a packed scene, or a damaged one ({reason})") from error


def _put(archive: zipfile.ZipFile, name: str, data: bytes) -> None:
    # A fixed time stamp, so that the same scene gives the same bytes.
    entry = zipfile.ZipInfo(name, date_time=(1980, 1, 1, 0, 0, 0))
    entry.compress_type = zipfile.ZIP_DEFLATED
    archive.writestr(entry, data)


def _document(data: bytes, file: Path) -> _PackedDocument:
    values = json.loads(data)
    if not isinstance(values, dict) or values.get("format") != FORMAT:
        raise BundleError(f"{file}: holds no packed scene; its format must be {FORMAT!r}")
    if values.get("version") != VERSION:
        raise BundleError(
            f"{file}: version {values.get('version')!r} of {FORMAT}; "
            f"this program reads version {VERSION}"
        )
    try:
        return _PackedDocument.model_validate(values)
    except ValidationError as error:
        raise BundleError(f"{file}: {DOCUMENT} is damaged: {error.errors()[0]['msg']}") from error


def _pack_ground(ground: Ground, arrays: Arrays) -> _PackedGround:
    """Store heights as differences along both axes, which are mostly zero and compress well."""
    steps = np.round(ground.heights.astype(np.float64) / HEIGHT_STEP).astype(np.int32)
    along = np.diff(steps, axis=0, prepend=np.int32(0))
    arrays["ground.heights"] = np.diff(along, axis=1, prepend=np.int32(0))
    arrays["ground.is_ground"] = ground.is_ground
    x, y = ground.origin.tolist()
    return _PackedGround(origin=(x, y), cell=ground.cell)


def _unpack_ground(part: _PackedGround, arrays: Arrays) -> Ground:
    steps = arrays["ground.heights"].astype(np.int64).cumsum(axis=1).cumsum(axis=0)
    return Ground(
        np.array(part.origin),
        part.cell,
        (steps * HEIGHT_STEP).astype(np.float32),
        arrays["ground.is_ground"],
    )


def _pack_object(item: SceneObject, key: str, arrays: Arrays) -> _PackedObject:
    colour = item.colour
    if colour is not None:
        arrays[f"{key}.fourier"] = colour.coefficients.detach().cpu().numpy().astype(np.float16)
    figure = item.figure
    if figure is not None:
        figure.check_values(f"object {item.object_id!r}")
        arrays[f"{key}.joints"] = figure.joints.numpy()
        arrays[f"{key}.weights"] = figure.weights.numpy()
    return _PackedObject(
        object_id=item.object_id,
        category=item.category,
        size=item.size,
        trajectory=TrajectoryPart.of(item.trajectory),
        cloud=_pack_cloud(item.cloud, key, arrays),
        colour=colour
        and _PackedColour(basis=colour.basis, start_us=colour.start_us, end_us=colour.end_us),
        figure=figure
        and _PackedFigure(
            shape=list(figure.shape),
            height=figure.height,
            middle=figure.middle,
            style=GaitPart(**asdict(figure.style)),
        ),
    )


def _pack_cloud(cloud: GaussianCloud, key: str, arrays: Arrays) -> _PackedCloud:
    """Quantise, and sort Gaussians along a space-filling curve, so that they compress well."""
    cloud.check_values(key)
    cloud = cloud.to("cpu")
    low, extent = np.zeros(3), np.ones(3)
    if len(cloud):
        low = cloud.means.amin(0).double().numpy()
        extent = np.maximum(cloud.means.amax(0).double().numpy() - low, 1e-6)
    share = (cloud.means.double().numpy() - low) / extent
    means = (share * MEAN_STEPS).round().astype(np.uint16)
    order = np.argsort(_curve(means), kind="stable")
    quats = torch.nn.functional.normalize(cloud.quats, dim=1)
    log_scales = (cloud.scales.log() - LOWEST_LOG_SCALE) * LOG_SCALE_STEPS
    rest = cloud.sh[:, 1:].numpy()
    sh_range = float(np.abs(rest).max()) if rest.size else 0.0
    packed: Arrays = {
        "means": means,
        "quats": (quats.numpy() * QUAT_STEPS).round().astype(np.int8),
        "log_scales": log_scales.clamp(0, 65535).round().numpy().astype(np.uint16),
        "opacities": (cloud.opacities.numpy() * OPACITY_STEPS).round().astype(np.uint8),
        "colours": cloud.sh[:, 0].numpy().astype(np.float16),
        "sh": (rest / max(sh_range, 1e-12) * SH_STEPS).round().astype(np.int8),
    }
    if cloud.uncertainties is not None:
        packed[UNCERTAINTIES] = _root_steps(cloud.uncertainties)
    for name, values in packed.items():
        arrays[f"{key}.{name}"] = np.ascontiguousarray(values[order])
    for name in ("fourier", "joints", "weights"):
        if f"{key}.{name}" in arrays:
            arrays[f"{key}.{name}"] = arrays[f"{key}.{name}"][order]
    return _PackedCloud(low=_vector(low), extent=_vector(extent), sh_range=sh_range)


def _curve(means: NDArray[np.uint16]) -> NDArray[np.int64]:
    """Position of quantised centres [N, 3] along a Morton curve, ten bits per axis."""
    code = np.zeros(len(means), np.int64)
    coarse = (means >> 6).astype(np.int64)
    for bit in range(10):
        for axis in range(3):
            code |= ((coarse[:, axis] >> bit) & 1) << (3 * bit + axis)
    return code


def _scene(document: _PackedDocument, arrays: Arrays) -> Scene:
    objects = {}
    for index, part in enumerate(document.objects):
        colour = None
        if part.colour is not None:
            fourier = torch.from_numpy(arrays[f"{index}.fourier"].astype(np.float32))
            colour = TimeColour(
                fourier, part.colour.basis, part.colour.start_us, part.colour.end_us
            )
        objects[part.object_id] = SceneObject(
            object_id=part.object_id,
            category=part.category,
            size=part.size,
            cloud=_cloud(part.cloud, f"{index}", arrays),
            trajectory=part.trajectory.build(),
            colour=colour,
            figure=_figure(part.figure, f"{index}", arrays),
        )
    return Scene(
        name=document.name,
        background=_cloud(document.background, "background", arrays),
        objects=objects,
        sky=_sky(arrays),
        rig=CameraRig(tuple(camera.build() for camera in document.cameras)),
        ego=document.ego.build(),
        frame_times_us=np.array(document.frame_times_us, dtype=np.int64),
        ego_size=document.ego_size,
        provenance=document.provenance,
        stored_ground=_unpack_ground(document.ground, arrays),
        sunlight=document.sunlight.build() if document.sunlight else None,
    )


def _figure(part: _PackedFigure | None, key: str, arrays: Arrays) -> Figure | None:
    if part is None:
        return None
    figure = Figure(
        tuple(part.shape),
        part.height,
        part.middle,
        torch.from_numpy(arrays[f"{key}.joints"]),
        torch.from_numpy(arrays[f"{key}.weights"]),
        GaitStyle(**part.style.model_dump()),
    )
    figure.check_values(key)
    return figure


def _sky(arrays: Arrays) -> Sky | None:
    faces, known = arrays.get("sky"), arrays.get(SKY_UNCERTAINTIES)
    if faces is None:
        return None
    uncertainties = None if known is None else _from_root_steps(known)
    sky = Sky(torch.from_numpy(faces.astype(np.float32) / 255), uncertainties)
    sky.check_values()
    return sky


def _cloud(part: _PackedCloud, key: str, arrays: Arrays) -> GaussianCloud:
    held = {
        name: arrays[f"{key}.{name}"]
        for name in ("means", "quats", "log_scales", "opacities", "colours", "sh")
    }
    means = held["means"] / MEAN_STEPS * np.array(part.extent) + np.array(part.low)
    log_scales = held["log_scales"] / LOG_SCALE_STEPS + LOWEST_LOG_SCALE
    sh = np.concatenate(
        [held["colours"][:, None].astype(np.float32), held["sh"] / SH_STEPS * part.sh_range], axis=1
    )
    known = arrays.get(f"{key}.{UNCERTAINTIES}")
    cloud = GaussianCloud(
        means=_tensor(means),
        quats=torch.nn.functional.normalize(_tensor(held["quats"]), dim=1),
        scales=_tensor(np.exp(log_scales)),
        opacities=_tensor(held["opacities"] / OPACITY_STEPS),
        sh=_tensor(sh),
        uncertainties=None if known is None else _from_root_steps(known),
    )
    cloud.check_values(key)
    return cloud


def _root_steps(uncertainties: Tensor) -> NDArray[np.uint8]:
    """Quantise small uncertainties more finely than large ones."""
    return (uncertainties.cpu().sqrt() * UNCERTAINTY_STEPS).round().numpy().astype(np.uint8)


def _from_root_steps(steps: NDArray[Any]) -> Tensor:
    return _tensor((steps / UNCERTAINTY_STEPS) ** 2)


def _tensor(array: NDArray[Any]) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32))


def _vector(values: NDArray[np.float64]) -> Vector3:
    x, y, z = values.tolist()
    return x, y, z


# The bundled street, used by the demo and served by a worker without scenes.

SHIPPED_STREET = Path(__file__).parents[2] / "demo" / "street.r2s.zip"
"""A packed scene; rebuilt by ``python -m real2sim_server.demo.street``."""

DEMO_SCENE = "demo_street"
"""Name of the bundled street on a server."""


PACKED_SUFFIX = ".r2s.zip"


def open_scene(name: str | PathLike[str], folder: Path | None = None) -> Scene:
    """A scene by path or name: a bundle, a packed scene, or the bundled street.

    Args:
        name: path of a bundle or packed scene, name of a bundle in ``folder``, or ``DEMO_SCENE``.
        folder: folder of bundles.

    Raises:
        BundleError: there is no such scene, or it cannot be read.
    """
    for place in (Path(name), *([folder / name] if folder is not None else [])):
        if place.is_dir():
            return load_scene(place)
    file = SHIPPED_STREET if str(name) == DEMO_SCENE else Path(name)
    if not (file.name.endswith(PACKED_SUFFIX) and file.is_file()):
        raise BundleError(
            f"no scene {str(name)!r}; give the path of a bundle (a folder with scene.json) or of a "
            f"packed scene ({PACKED_SUFFIX}), the name of a bundle in the folder of --scenes, or "
            f"{DEMO_SCENE}"
        )
    # A bundle has the hash that recordings and workers know the scene by.
    with tempfile.TemporaryDirectory(prefix="real2sim-scene-") as made:
        save_scene(read_packed(file), Path(made) / "scene")
        return load_scene(Path(made) / "scene")
