"""New scenes: a path below the import folder, or an uploaded splat file."""

from __future__ import annotations

import secrets
import shutil
from pathlib import Path
from typing import Any

from fastapi import APIRouter, Request, Response
from fastapi.exceptions import RequestValidationError
from pydantic import ValidationError
from starlette.datastructures import UploadFile

from real2sim_proto import ErrorCode
from real2sim_proto.scenes import SceneImport, SceneInfo

from ..http.problems import ServiceError
from ..library.imports import import_scene, resolve_import, scene_name
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


router = APIRouter(prefix="/v1", tags=["scenes"])


@router.post("/scenes", status_code=201, response_model=SceneInfo, openapi_extra=_BODY)
async def import_(worker: WorkerOf, request: Request) -> Response:
    """Add a scene: a bundle or ply below the import folder (JSON), or an uploaded ply."""
    kind = request.headers.get("Content-Type", "").split(";")[0].strip().lower()
    if kind == "multipart/form-data":
        name = await _import_upload(worker, request)
    else:
        name = await _import_path(worker, await request.body())
    await worker.scene_cache.refresh()
    headers = {"Location": f"/v1/scenes/{name}"}
    return await scene_response(worker, name, status=201, headers=headers)


async def _import_path(worker: Worker, body: bytes) -> str:
    request = _parse(body)
    settings = worker.settings

    def work() -> str:
        source = resolve_import(settings.import_path, request.path)
        name = scene_name(source, request.scene)
        import_scene(source, scenes=settings.scenes_path, name=name)
        return name

    return await worker.scene_cache.on_disk_thread(work)


async def _import_upload(worker: Worker, request: Request) -> str:
    async with request.form(max_files=1, max_fields=1) as form:
        file, given = form.get("file"), form.get("scene")
        if not isinstance(file, UploadFile) or not isinstance(given, str | None):
            raise ServiceError(
                ErrorCode.INVALID_REQUEST,
                "the form needs a part 'file' with the splat file, and may have a field 'scene'",
            )
        scenes = worker.settings.scenes_path

        def work() -> str:
            name = scene_name(Path(file.filename or "upload"), given)
            stored = _store_upload(file, scenes)
            try:
                import_scene(stored, scenes=scenes, name=name)
            finally:
                stored.unlink()
            return name

        return await worker.scene_cache.on_disk_thread(work)


def _store_upload(file: UploadFile, scenes: Path) -> Path:
    """The upload as a hidden file beside the scenes: readers of splats map files into memory."""
    scenes.mkdir(parents=True, exist_ok=True)
    stored = scenes / f".upload-{secrets.token_hex(6)}.ply"
    with stored.open("xb") as target:
        shutil.copyfileobj(file.file, target, 1 << 20)
    return stored


def _parse(body: bytes) -> SceneImport:
    try:
        return SceneImport.model_validate_json(body)
    except ValidationError as error:
        found: list[Any] = [e | {"loc": ("body", *e["loc"])} for e in error.errors()]
        raise RequestValidationError(found) from error
