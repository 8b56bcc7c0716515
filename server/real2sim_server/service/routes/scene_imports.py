"""New scenes: a path below the import folder, the demo street, or an uploaded splat file."""

from __future__ import annotations

import asyncio
import shutil
from collections.abc import Awaitable, Callable
from functools import partial
from pathlib import Path
from typing import Any

from fastapi import APIRouter, Request, Response
from fastapi.exceptions import RequestValidationError
from pydantic import ValidationError
from starlette.datastructures import FormData, UploadFile

from real2sim_proto import ErrorCode
from real2sim_proto.scenes import SceneImport, SceneInfo

from ...scene.io import DEMO_SCENE, SHIPPED_STREET
from ...scene.io.formats import suffixes
from ..http.auth import TokenRoute
from ..http.idempotency import IdempotencyKey, form_digest
from ..http.problems import ServiceError
from ..library.claims import drop_claim
from ..library.imports import (
    import_errors,
    import_scene,
    resolve_import,
    scene_name,
    staging_folder,
)
from ..library.scene_catalog import bundle_folder
from ..worker import Worker, WorkerOf
from .scenes import scene_response

UPLOAD_PATHS = ("/v1/scenes",)
"""Where forms may be larger than other requests."""

_BODY = {
    "requestBody": {
        "required": True,
        "content": {
            "application/json": {
                "schema": SceneImport.model_json_schema(),
                "example": {"path": "street.r2s", "scene": "street"},
            },
            "multipart/form-data": {
                "schema": {
                    "type": "object",
                    "required": ["file"],
                    "properties": {
                        "file": {"type": "string", "format": "binary", "description": "a .ply"},
                        "scene": {"type": "string", "description": "name to give it"},
                    },
                }
            },
        },
    }
}


router = APIRouter(prefix="/v1", tags=["scenes"], route_class=TokenRoute)


@router.post("/scenes", status_code=201, response_model=SceneInfo, openapi_extra=_BODY)
async def import_(
    worker: WorkerOf, request: Request, idempotency_key: IdempotencyKey = None
) -> Response:
    """Add a scene: a bundle or ply below the import folder (JSON), the demo street
    (`{"demo": true}`), or an uploaded ply."""
    kind = request.headers.get("Content-Type", "").split(";")[0].strip().lower()
    with worker.imports.place():
        if kind != "multipart/form-data":
            add_scene = partial(_import_path, worker, await request.body())
            return await _imported(worker, request, idempotency_key, add_scene)
        async with request.form(max_files=1, max_fields=1) as form:
            content = await form_digest(form) if idempotency_key is not None else None
            add_scene = partial(_import_upload, worker, form)
            return await _imported(worker, request, idempotency_key, add_scene, content=content)


async def _imported(
    worker: Worker,
    request: Request,
    key: str | None,
    add_scene: Callable[[str | None], Awaitable[str]],
    *,
    content: bytes | None = None,
) -> Response:
    async with worker.idempotency.guard(request, key, content=content) as idempotent:
        if idempotent.replay:
            return worker.replayed(idempotent.replay)
        name = await add_scene(idempotent.claim)
        await worker.scene_cache.refresh()
        headers = {"Location": f"/v1/scenes/{name}"}
        response = await scene_response(worker, name, status=201, headers=headers)
        reply = idempotent.reply_bytes(bytes(response.body), status=201, headers=headers)
        await worker.idempotency.store(reply)
        if idempotent.claim is not None:
            await asyncio.to_thread(drop_claim, bundle_folder(worker.settings.scenes_path, name))
        return response


async def _import_path(worker: Worker, body: bytes, claim: str | None) -> str:
    request = _parse(body)
    settings = worker.settings

    def work() -> str:
        if request.path is None:
            source, name = SHIPPED_STREET, scene_name(SHIPPED_STREET, request.scene or DEMO_SCENE)
        else:
            source = resolve_import(settings.import_path, request.path)
            name = scene_name(source, request.scene)
        _import(worker, source, name, claim)
        return name

    return await worker.imports.run(work)


async def _import_upload(worker: Worker, form: FormData, claim: str | None) -> str:
    file, given = form.get("file"), form.get("scene")
    if not isinstance(file, UploadFile) or not isinstance(given, str | None):
        raise ServiceError(
            ErrorCode.INVALID_REQUEST,
            "the form needs a part 'file' with the splat file, and may have a field 'scene'",
        )

    def work() -> str:
        name = scene_name(Path(file.filename or "upload"), given)
        with (
            import_errors(Path("upload"), setting="MAX_SCENE_BYTES"),
            staging_folder(worker.settings.scenes_path) as staging,
        ):
            _import(worker, stored_upload(file, staging), name, claim)
        return name

    return await worker.imports.run(work)


def _import(worker: Worker, source: Path, name: str, claim: str | None) -> None:
    import_scene(
        source,
        scenes=worker.settings.scenes_path,
        name=name,
        limits=worker.scene_limits,
        quota=worker.scenes_quota,
        claim=claim,
    )


def stored_upload(file: UploadFile, staging: Path) -> Path:
    """The upload as a file in ``staging``: readers map files, and tell some formats by suffix."""
    given = Path(file.filename or "upload.ply").name.lower()
    ending = next((suffix for suffix in suffixes() if given.endswith(suffix)), ".ply")
    stored = staging / f"upload{ending}"
    with stored.open("xb") as target:
        shutil.copyfileobj(file.file, target, 1 << 20)
    return stored


def _parse(body: bytes) -> SceneImport:
    try:
        return SceneImport.model_validate_json(body)
    except ValidationError as error:
        found: list[Any] = [e | {"loc": ("body", *e["loc"])} for e in error.errors()]
        raise RequestValidationError(found) from error
