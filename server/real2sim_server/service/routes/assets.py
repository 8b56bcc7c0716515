"""The asset library: upload, cut out, query."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Annotated, Any, TypeVar

from fastapi import APIRouter, Query, Request, Response
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, ValidationError
from pydantic_core import from_json
from starlette.datastructures import FormData, UploadFile

from real2sim_proto import ErrorCode
from real2sim_proto.base import Identifier
from real2sim_proto.scenes import AssetCut, AssetInfo, AssetList, AssetPerson, AssetUpload

from ...render import encode_image
from ...scene.asset import person_asset
from ..http.auth import TokenRoute
from ..http.requests import IdempotencyKey, form_digest
from ..http.responses import ServiceError, info_response
from ..library.assets import draw_thumbnail, extract_object, import_asset
from ..library.imports import drop_claim, import_errors, scene_name, staging_folder
from ..worker import Worker, WorkerOf
from .scenes import stored_upload

UPLOAD_PATH = "/v1/assets"

_UPLOAD_SCHEMA = AssetUpload.model_json_schema()
_BODY: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "content": {
            "application/json": {
                "schema": {
                    "anyOf": [AssetCut.model_json_schema(), AssetPerson.model_json_schema()]
                },
                "example": {"scene": "demo_street", "object_id": "car_3", "asset_id": "red_car"},
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

router = APIRouter(prefix="/v1/assets", tags=["assets"], route_class=TokenRoute)


@router.post("", status_code=201, response_model=AssetInfo, openapi_extra=_BODY)
async def add(
    worker: WorkerOf, request: Request, idempotency_key: IdempotencyKey = None
) -> Response:
    """Add an asset: an object cut out of a scene or a walking person (JSON), or an uploaded
    splat file (form).

    Assets are upright with x forward, at a real size. They never change, and an id cannot be
    reused.
    """
    kind = request.headers.get("Content-Type", "").split(";")[0].strip().lower()
    with worker.imports.place():
        if kind != "multipart/form-data":
            body = await request.body()
            make = _person if _names_a_build(body) else _extract
            add_asset = partial(make, worker, body)
            return await _added(worker, request, idempotency_key, add_asset)
        async with request.form(max_files=1, max_fields=len(AssetUpload.model_fields)) as form:
            content = await form_digest(form) if idempotency_key is not None else None
            add_asset = partial(_upload, worker, form)
            return await _added(worker, request, idempotency_key, add_asset, content=content)


async def _added(
    worker: Worker,
    request: Request,
    key: str | None,
    add_asset: Callable[[str | None], Awaitable[AssetInfo]],
    *,
    content: bytes | None = None,
) -> Response:
    async with worker.idempotency.guard(request, key, content=content) as idempotent:
        if idempotent.replay:
            return worker.replayed(idempotent.replay)
        info = await add_asset(idempotent.claim)
        headers = {"Location": f"/v1/assets/{info.asset_id}"}
        await worker.idempotency.store(idempotent.reply(info, status=201, headers=headers))
        if idempotent.claim is not None:
            await asyncio.to_thread(drop_claim, worker.assets.bundle(info.asset_id))
        return info_response(info, status=201, headers=headers)


@router.get("")
async def list_assets(worker: WorkerOf) -> AssetList:
    """All assets of the library."""
    return AssetList(assets=await asyncio.to_thread(worker.assets.list))


@router.get("/{asset_id}")
async def describe(worker: WorkerOf, asset_id: Identifier) -> AssetInfo:
    """One asset."""
    return await asyncio.to_thread(worker.assets.info, asset_id)


@router.delete("/{asset_id}", status_code=204, response_class=Response)
async def delete(
    worker: WorkerOf,
    asset_id: Identifier,
    dry_run: Annotated[bool, Query(description="validate without storing")] = False,
) -> Response:
    """Delete an asset that no scenario's history refers to; its id becomes available again.

    Sessions that show it continue.
    """
    await asyncio.to_thread(worker.assets.info, asset_id)
    await _check_unused(worker, asset_id)
    if dry_run:
        return Response(status_code=204)
    with worker.assets.removing(asset_id):
        # Check again: an edit in progress may have looked the asset up before.
        await _check_unused(worker, asset_id)
        if worker.sharing is not None:
            await worker.sharing.forget("asset", asset_id)
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
    """A picture of the asset from its front left, with an aspect ratio of 4:3."""
    asset = (await asyncio.to_thread(worker.assets.get, asset_id)).asset
    pixels = await worker.engine.call(
        draw_thumbnail, asset, width=width, backend=worker.backend, label="thumbnail"
    )
    encoded = await asyncio.to_thread(encode_image, pixels, "rgb", "png", quality=90)
    # An id always refers to the same asset.
    headers = {"Cache-Control": "public, max-age=86400, immutable"}
    return Response(encoded.data, media_type="image/png", headers=headers)


async def _check_unused(worker: Worker, asset_id: str) -> None:
    users = await worker.scenarios.using_asset(asset_id)
    if users:
        named = {info.scenario_id: info.name for info in await worker.scenarios.list()}
        shown = [f"{named[u]!r} ({u})" if named.get(u) else u for u in users[:3]]
        more = f" and {len(users) - 3} more" if len(users) > 3 else ""
        raise ServiceError(
            ErrorCode.ASSET_IN_USE,
            f"asset {asset_id!r} is in the history of {', '.join(shown)}{more}",
            hint="delete those scenarios first",
        )


async def _extract(worker: Worker, body: bytes, claim: str | None) -> AssetInfo:
    cut = _parsed(AssetCut, body)
    scene = await worker.scene_cache.get(cut.scene)
    asset_id = cut.asset_id or cut.object_id

    def work() -> AssetInfo:
        if (made := worker.assets.made_by(claim, asset_id)) is not None:
            return made
        asset = extract_object(scene, cut.object_id, asset_id=asset_id, category=cut.category)
        worker.assets.check_free(asset_id)
        worker.assets_quota.check(added_bytes=asset.nbytes)
        return worker.assets.add(asset, claim=claim)

    return await worker.imports.run(work)


def _names_a_build(body: bytes) -> bool:
    try:
        given = from_json(body)  # Refuses deep nesting, where json.loads() raises RecursionError.
    except ValueError:
        return False
    return isinstance(given, dict) and "build" in given


async def _person(worker: Worker, body: bytes, claim: str | None) -> AssetInfo:
    asked = _parsed(AssetPerson, body)

    def work() -> AssetInfo:
        if (made := worker.assets.made_by(claim, asked.asset_id)) is not None:
            return made
        worker.assets.check_free(asked.asset_id)
        asset = person_asset(
            asked.asset_id,
            asked.build,
            height=asked.height,
            clothes={str(name): (r, g, b) for name, (r, g, b) in asked.clothes.items()},
            worn=asked.worn,
        )
        worker.assets_quota.check(added_bytes=asset.nbytes)
        return worker.assets.add(asset, claim=claim)

    return await worker.imports.run(work)


async def _upload(worker: Worker, form: FormData, claim: str | None) -> AssetInfo:
    file = form.get("file")
    if not isinstance(file, UploadFile):
        raise ServiceError(
            ErrorCode.INVALID_REQUEST,
            "the form needs a part 'file' with the splat file",
            hint="curl -F file=@car.ply -F category=car",
        )
    fields = {name: value for name, value in form.items() if name != "file"}
    upload = _parsed(AssetUpload, fields)

    def work() -> AssetInfo:
        asset_id = upload.asset_id or scene_name(Path(file.filename or "asset"), None)
        with (
            import_errors(Path("upload"), setting="MAX_ASSET_BYTES"),
            staging_folder(worker.assets.folder) as staging,
        ):
            return import_asset(
                worker.assets,
                stored_upload(file, staging),
                upload,
                asset_id=asset_id,
                limits=worker.asset_limits,
                quota=worker.assets_quota,
                claim=claim,
            )

    return await worker.imports.run(work)


def _parsed(model: type[M], given: bytes | Mapping[str, Any]) -> M:
    """A model of a JSON body or of the fields of a form."""
    try:
        if isinstance(given, bytes):
            return model.model_validate_json(given)
        return model.model_validate(given)
    except ValidationError as error:
        found: list[Any] = [e | {"loc": ("body", *e["loc"])} for e in error.errors()]
        raise RequestValidationError(found) from error
