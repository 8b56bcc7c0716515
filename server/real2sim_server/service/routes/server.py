"""The server: its status, health and metrics, the API reference, the studio."""

from __future__ import annotations

import base64
import hashlib
import re
from importlib.metadata import version
from pathlib import Path
from typing import get_args

from fastapi import APIRouter, Depends, Request, Response
from fastapi.responses import HTMLResponse, RedirectResponse

from real2sim_proto import CONVENTIONS, PROTOCOL_VERSION, ErrorCode
from real2sim_proto.base import Codec, Modality
from real2sim_proto.codec import MAX_CLIENT_MESSAGE_BYTES
from real2sim_proto.conventions import SUPPORTED_SUBPROTOCOLS
from real2sim_proto.episode import MAX_SENSORS
from real2sim_proto.scenarios import MAX_OPERATIONS_PER_REQUEST
from real2sim_proto.scenes import Fleet, FleetMember, Limits, Readiness, ServerInfo
from real2sim_proto.sessions import MAX_STEPS_PER_REQUEST

from ...scene.range_sensors import RADARS, lidar_names
from ...settings import Settings
from ..http.auth import TokenRoute, require_token
from ..http.openapi import POLICY, published, reference_page
from ..http.responses import ServiceError
from ..worker import WorkerOf

router = APIRouter(prefix="/v1", tags=["server"], route_class=TokenRoute)


@router.get("/server")
async def describe(worker: WorkerOf) -> ServerInfo:
    """Versions, device, limits, codecs, frames and units."""
    return ServerInfo(
        version=version("real2sim"),
        protocol_version=PROTOCOL_VERSION,
        subprotocols=list(SUPPORTED_SUBPROTOCOLS),
        worker_id=worker.settings.worker_id,
        device=worker.device,
        limits=limits_of(worker.settings),
        codecs=list(get_args(Codec)),
        modalities=list(get_args(Modality)),
        lidar_models=list(lidar_names()),
        radar_models=list(RADARS),
        conventions=CONVENTIONS,
    )


@router.get("/fleet")
async def fleet(worker: WorkerOf) -> Fleet:
    """The workers that share this one's store, with the last status each reported."""
    members = [
        FleetMember.model_validate({**row.document, "worker_id": row.worker_id, "alive": row.alive})
        for row in await worker.leases.workers()
    ]
    return Fleet(workers=members)


def limits_of(settings: Settings) -> Limits:
    """The limits set by ``settings`` and the protocol."""
    return Limits(
        max_sessions=settings.max_sessions,
        max_request_bytes=settings.max_request_bytes,
        max_message_bytes=MAX_CLIENT_MESSAGE_BYTES,
        max_operations_per_request=MAX_OPERATIONS_PER_REQUEST,
        max_cameras_per_step=MAX_SENSORS,
        max_pixels_per_step=settings.max_pixels_per_step,
        max_rays_per_step=settings.max_rays_per_step,
        max_steps_per_request=MAX_STEPS_PER_REQUEST,
        scene_memory_bytes=settings.scene_memory_bytes,
        queue_length=settings.queue_length,
    )


# --- Reference -----------------------------------------------------------------------------------

docs_router = APIRouter(include_in_schema=False)


@docs_router.get("/docs")
async def docs(request: Request) -> HTMLResponse:
    """Every call with its parameters, replies and an example."""
    page = reference_page(published(request.app))
    return HTMLResponse(page, headers={"Content-Security-Policy": POLICY})


# --- Health --------------------------------------------------------------------------------------

health_router = APIRouter(tags=["health"])


@health_router.get(
    "/livez",
    responses={503: {"model": dict[str, str], "description": "dead or stalled, and why"}},
)
async def live(worker: WorkerOf, response: Response) -> dict[str, str]:
    """200 while the engine thread responds; on 503 the worker needs a restart."""
    engine = worker.engine
    if not engine.alive:
        response.status_code = 503
        return {"status": "dead", "reason": f"engine: {engine.failure or 'its thread has ended'}"}
    if engine.seconds_since_tick > worker.settings.stall_seconds:
        response.status_code = 503
        reason = f"job {engine.running!r} runs for {engine.seconds_since_tick:.0f} s"
        return {"status": "stalled", "reason": reason}
    return {"status": "alive"}


@health_router.get("/readyz", responses={503: {"model": Readiness, "description": "not ready"}})
async def ready(worker: WorkerOf, response: Response) -> Readiness:
    """200 if the worker accepts new work; else 503 with the reasons."""
    readiness = worker.readiness()
    if not readiness.ready:
        response.status_code = 503
        response.headers["Retry-After"] = "1"
    return readiness


@health_router.get("/metrics", dependencies=[Depends(require_token)], response_class=Response)
async def metrics(worker: WorkerOf) -> Response:
    """Prometheus metrics."""
    if not worker.settings.metrics:
        raise ServiceError(ErrorCode.NOT_FOUND, "metrics are turned off by REAL2SIM_METRICS")
    body, media_type = await worker.metrics.exposition()
    return Response(body, media_type=media_type)


# --- Studio --------------------------------------------------------------------------------------

FOLDER = Path(__file__).parents[1] / "ui"
MEDIA_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
}
IMPORT_MAP = re.compile(r'<script type="importmap">(.*?)</script>', re.DOTALL)


def policy_of(page: str) -> str:
    """Content security policy: no external content, because the studio works offline.

    The import map of the page's vendored modules is allowed by its hash. The Gaussian renderer
    sorts in WebAssembly loaded from ``data:``, in a web worker created from a ``blob:``.
    """
    maps = IMPORT_MAP.findall(page)
    hashes = (base64.b64encode(hashlib.sha256(m.encode()).digest()).decode() for m in maps)
    allowed = " ".join(f"'sha256-{h}'" for h in hashes)
    return (
        f"default-src 'none'; script-src 'self' 'wasm-unsafe-eval' {allowed}; style-src 'self'; "
        "img-src 'self' blob: data:; connect-src 'self' ws: wss: data:; worker-src blob:; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )


CONTENT_POLICY = policy_of((FOLDER / "index.html").read_text(encoding="utf-8"))

ui_router = APIRouter(include_in_schema=False)


@ui_router.get("/")
@ui_router.get("/ui")
async def entry() -> Response:
    """Redirect to the studio, relative because a proxy may serve it below a path."""
    return RedirectResponse("ui/")


@ui_router.get("/ui/{name:path}")
async def file(name: str) -> Response:
    """One file of the studio. Raises ServiceError: NOT_FOUND."""
    path = STUDIO.get(name or "index.html")
    if path is None:
        raise ServiceError(
            ErrorCode.NOT_FOUND,
            f"the studio has no file {name!r}",
            hint="open /ui/",
        )
    headers = {
        # Vendored files have their version in their path.
        "Cache-Control": "public, max-age=31536000, immutable"
        if name.startswith("vendor/")
        else "no-cache",
        "Content-Security-Policy": CONTENT_POLICY,
    }
    return Response(path.read_bytes(), media_type=MEDIA_TYPES[path.suffix], headers=headers)


# Files are listed once. Request paths are looked up here and never joined to a folder.
STUDIO = {
    p.relative_to(FOLDER).as_posix(): p
    for p in sorted(FOLDER.rglob("*"))
    if p.suffix in MEDIA_TYPES
}
"""Files of the studio by path."""
