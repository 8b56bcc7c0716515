"""The worker as an ASGI application."""

from __future__ import annotations

import tempfile
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

from fastapi import APIRouter, Depends, FastAPI
from fastapi.routing import APIRoute
from starlette.exceptions import HTTPException
from starlette.types import Message, Scope

from real2sim_proto import Problem
from real2sim_proto.jobs import JobInfo

from ..settings import Settings
from .accounts import ACCOUNT
from .audit import AuditEntry
from .clock import now_us
from .http.auth import READING, LoopbackOnly, OwnPagesOnly, account_of, require_token
from .http.openapi import document, published, text_of
from .http.requests import BodyLimit, RequestContext, install_replay_handler
from .http.responses import install_problem_handlers
from .http.telemetry import Tracing, engine_spans, traces_to
from .jobs import Work
from .routes import assets, jobs, scenarios, scenes, server, sessions, sockets
from .worker import Worker

if TYPE_CHECKING:
    from opentelemetry.sdk.trace import TracerProvider

STEPS = ("/step", "/render", "/reset")
"""Path suffixes of frequent calls without shared effects."""

PROTECTED: tuple[APIRouter, ...] = (
    server.router,
    scenes.router,
    scenes.object_router,
    scenarios.router,
    scenarios.storyboards_router,
    assets.router,
    jobs.router,
    jobs.exports_router,
    jobs.sweeps_router,
)
"""Routers that require the worker's token."""

OPEN: tuple[APIRouter, ...] = (
    server.health_router,
    sessions.router,
    sockets.router,
    sockets.view_router,
    server.ui_router,
    server.docs_router,
)
"""Routers that check tokens themselves."""


def operation_id(route: APIRoute) -> str:
    """Operation id in OpenAPI, derived from the function's name, such as ``scenes-render``."""
    subject = str(route.tags[0]) if route.tags else "worker"
    return f"{subject}-{route.name}"


CALLS = APIRouter(
    generate_unique_id_function=operation_id,
    responses={"default": {"model": Problem, "description": "problem+json (RFC 9457)"}},
)
"""All routes of a worker."""

for _router in OPEN:
    CALLS.include_router(_router)
for _router in PROTECTED:
    CALLS.include_router(_router, dependencies=[Depends(require_token)])


def create_app(settings: Settings) -> FastAPI:
    """The application of one worker; it starts and stops with the application's lifespan.

    Raises:
        RenderError: the backend of the settings cannot be used here.
    """
    worker = Worker.build(settings)
    worker.jobs.rebuild = partial(_work_again, worker)

    @asynccontextmanager
    async def lifespan(_app: FastAPI) -> AsyncIterator[None]:
        # Before anything else runs: FastAPI builds its routes at the first request and uses
        # warnings.catch_warnings(), which is not thread-safe.
        await _build_routes(app)
        app.openapi_schema = published(app)
        async with AsyncExitStack() as at_exit:
            try:
                await at_exit.enter_async_context(worker.running())
            except Exception as error:
                worker.start_error = error
                raise
            yield

    app = FastAPI(
        title="Real2Sim worker",
        version=version("real2sim"),
        lifespan=lifespan,
        docs_url=None,
        redoc_url=None,
        separate_input_output_schemas=False,
    )
    app.state.worker = worker
    upload_paths = (*scenes.UPLOAD_PATHS, assets.UPLOAD_PATH)
    uploads = dict.fromkeys(upload_paths, settings.max_upload_bytes)
    install_problem_handlers(app)
    install_replay_handler(app, worker.replayed)
    app.add_middleware(BodyLimit, limit=settings.max_request_bytes, uploads=uploads)
    if not settings.needs_token:
        app.add_middleware(LoopbackOnly)
    app.add_middleware(OwnPagesOnly)
    if settings.traces_url is not None:
        trace(app, worker, traces_to(settings.traces_url, worker_id=settings.worker_id))
    app.add_middleware(RequestContext, metrics=worker.metrics, on_end=partial(note_request, worker))
    # Routers are shared: include_router() would prepare all routes again for each application.
    app.router.routes.extend(CALLS.routes)
    return app


async def _build_routes(app: FastAPI) -> None:
    """Pass a request that matches no route through all of them."""

    async def receive() -> Message:
        return {"type": "http.disconnect"}

    async def send(_message: Message) -> None:
        """Discard the message."""

    unmatched = {"type": "http", "method": "GET", "path": "/unmatched", "headers": [], "app": app}
    with suppress(HTTPException):
        await app.router(unmatched | {"query_string": b"", "root_path": ""}, receive, send)


def trace(app: FastAPI, worker: Worker, provider: TracerProvider) -> None:
    """Create spans for requests and their engine jobs."""
    app.add_middleware(Tracing, provider=provider)
    worker.engine.on_queued = engine_spans(provider)


def note_request(worker: Worker, scope: Scope, method: str, status: int, request_id: str) -> None:
    """Log changes and refusals for a token or role in the audit log. The steps of a session are
    recorded with the session."""
    path = scope["path"]
    refused = status in (401, 403)
    if not refused and (method in READING or status >= 400 or path.endswith(STEPS)):
        return
    account = account_of(scope)
    worker.audit.note(
        AuditEntry(
            account=account.name if account is not None else "",
            client=(scope.get("client") or ("",))[0],
            worker_id=worker.settings.worker_id,
            method=method,
            path=path[:1000],
            status=status,
            request_id=request_id,
            at_us=now_us(),
        )
    )


async def _work_again(worker: Worker, info: JobInfo) -> Work:
    """Rebuild the work of a stored job, for its original account."""
    ACCOUNT.set(worker.accounts.of_owner(info.owner))
    if info.kind == "simulate":
        return await worker.simulations.rebuild(info)
    if info.kind == "sweep":
        return await worker.sweeps.rebuild(info)
    return await jobs.rebuild(worker, info)


def openapi_text() -> str:
    """The OpenAPI document of a worker with default settings, as JSON."""
    with tempfile.TemporaryDirectory() as folder:
        return text_of(document(create_app(Settings(data_dir=Path(folder)))))
