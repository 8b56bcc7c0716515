"""The asset library: upload, cut out, look."""

from __future__ import annotations

import asyncio
import secrets
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, TypeVar

from fastapi import APIRouter, Query, Request, Response
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, ValidationError
from starlette.datastructures import UploadFile

from real2sim_proto import ErrorCode
from real2sim_proto.assets import AssetCut, AssetInfo, AssetList, AssetUpload
from real2sim_proto.base import Identifier

from ...render import encode_image
from ...scene.io.formats import suffixes
from ..http.problems import ServiceError
from ..http.responses import info_response
from ..library.assets import LibraryAsset, extract_object, import_asset
from ..library.imports import scene_name
from ..library.thumbnails import draw_thumbnail
from ..worker import Worker, WorkerOf

UPLOAD_PATH = "/v1/assets"

_UPLOAD_SCHEMA = AssetUpload.model_json_schema()
_BODY: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "content": {
            "application/json": {
                "schema": AssetCut.model_json_schema(),
                "example": {"scene": "street", "object_id": "car_3", "asset_id": "red_car"},
            },
            "multipart/form-data": {
                "schema": _UPLOAD_SCHEMA
                | {
                    "required": ["file"],
                    "properties": {
                        "file": {
                            "type": "string",
                            "format": "binary",
                            "description": ".ply, .compressed.ply, .spz or .splat",
                        }
                    }
                    | _UPLOAD_SCHEMA["properties"],
                }
            },
        },
    }
}

M = TypeVar("M", bound=BaseModel)

router = APIRouter(prefix="/v1/assets", tags=["assets"])


@router.post("", status_code=201, response_model=AssetInfo, openapi_extra=_BODY)
async def add(worker: WorkerOf, request: Request) -> Response:
    """Add an asset: an object cut out of a scene (JSON), or an uploaded splat file (form).

    Assets stand upright with x forward, at a real size, and never change: an id that is taken
    stays taken.
    """
    kind = request.headers.get("Content-Type", "").split(";")[0].strip().lower()
    if kind == "multipart/form-data":
        asset = await _upload(worker, request)
    else:
        asset = await _extract(worker, _parsed(AssetCut, await request.body()))
    info = asset.info()
    headers = {"Location": f"/v1/assets/{info.asset_id}"}
    return info_response(info, status=201, headers=headers)


@router.get("")
async def list_assets(worker: WorkerOf) -> AssetList:
    """The whole library."""
    assets = await asyncio.to_thread(worker.assets.list)
    return AssetList(assets=[asset.info() for asset in assets])


@router.get("/{asset_id}")
async def describe(worker: WorkerOf, asset_id: Identifier) -> AssetInfo:
    """One asset."""
    return (await asyncio.to_thread(worker.assets.get, asset_id)).info()


@router.delete("/{asset_id}", status_code=204, response_class=Response)
async def delete(worker: WorkerOf, asset_id: Identifier) -> Response:
    """Remove an asset that no scenario has in its history; its id may then be given again.

    Sessions that show it go on.
    """
    asset = await asyncio.to_thread(worker.assets.get, asset_id)
    await _check_unused(worker, asset.asset_id)
    with worker.assets.removing(asset_id):
        # Once more: an edit that was under way may have found it before.
        await _check_unused(worker, asset_id)
        await worker.scene_cache.on_disk_thread(lambda: worker.assets.remove(asset_id))
    return Response(status_code=204)


@router.get(
    "/{asset_id}/thumbnail",
    response_class=Response,
    responses={
        200: {
            "description": "picture",
            "content": {"image/png": {"schema": {"type": "string", "format": "binary"}}},
        }
    },
)
async def thumbnail(
    worker: WorkerOf, asset_id: Identifier, width: Annotated[int, Query(ge=32, le=1024)] = 256
) -> Response:
    """A picture of the asset from its front left, three quarters as high as it is wide."""
    asset = (await asyncio.to_thread(worker.assets.get, asset_id)).asset
    pixels = await worker.engine.call(
        draw_thumbnail, asset, width=width, backend=worker.backend, label="thumbnail"
    )
    encoded = await asyncio.to_thread(encode_image, pixels, "rgb", "png", quality=90)
    # The same id is the same asset for ever.
    headers = {"Cache-Control": "public, max-age=86400, immutable"}
    return Response(encoded.data, media_type="image/png", headers=headers)


async def _check_unused(worker: Worker, asset_id: str) -> None:
    users = await worker.scenarios.using_asset(asset_id)
    if users:
        more = f" and {len(users) - 3} more" if len(users) > 3 else ""
        raise ServiceError(
            ErrorCode.ASSET_IN_USE,
            f"asset {asset_id!r} is in the history of {', '.join(users[:3])}{more}",
            hint="delete those scenarios first",
        )


async def _extract(worker: Worker, cut: AssetCut) -> LibraryAsset:
    scene = await worker.scene_cache.get(cut.scene)
    asset_id = cut.asset_id or cut.object_id

    def work() -> LibraryAsset:
        asset = extract_object(scene, cut.object_id, asset_id=asset_id, category=cut.category)
        return worker.assets.add(asset)

    return await worker.scene_cache.on_disk_thread(work)


async def _upload(worker: Worker, request: Request) -> LibraryAsset:
    async with request.form(max_files=1, max_fields=len(AssetUpload.model_fields)) as form:
        file = form.get("file")
        if not isinstance(file, UploadFile):
            raise ServiceError(
                ErrorCode.INVALID_REQUEST,
                "the form needs a part 'file' with the splat file",
                hint="curl -F file=@car.ply -F category=car",
            )
        fields = {name: value for name, value in form.items() if name != "file"}
        upload = _parsed(AssetUpload, fields)

        def work() -> LibraryAsset:
            asset_id = upload.asset_id or scene_name(Path(file.filename or "asset"), None)
            stored = _stored(file, worker.assets.folder)
            try:
                return worker.assets.add(import_asset(stored, upload, asset_id=asset_id))
            finally:
                stored.unlink()

        return await worker.scene_cache.on_disk_thread(work)


def _stored(file: UploadFile, folder: Path) -> Path:
    """The upload as a hidden file: readers map files into memory, and tell formats by suffix."""
    folder.mkdir(parents=True, exist_ok=True)
    given = Path(file.filename or "upload.ply").name.lower()
    ending = next((suffix for suffix in suffixes() if given.endswith(suffix)), ".ply")
    stored = folder / f".upload-{secrets.token_hex(6)}{ending}"
    with stored.open("xb") as target:
        shutil.copyfileobj(file.file, target, 1 << 20)
    return stored


def _parsed(model: type[M], given: bytes | Mapping[str, Any]) -> M:
    """A model of a JSON body or of the fields of a form."""
    try:
        if isinstance(given, bytes):
            return model.model_validate_json(given)
        return model.model_validate(given)
    except ValidationError as error:
        found: list[Any] = [e | {"loc": ("body", *e["loc"])} for e in error.errors()]
        raise RequestValidationError(found) from error
