"""The worker as an ASGI application."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from importlib.metadata import version

from fastapi import APIRouter, Depends, FastAPI
from fastapi.routing import APIRoute

from real2sim_proto import Problem

from ..settings import Settings
from .http.auth import require_token
from .http.hosts import LoopbackOnly
from .http.openapi import published
from .http.problems import install_problem_handlers
from .http.requests import BodyLimit, RequestContext
from .routes import (
    assets,
    drive,
    exports,
    health,
    jobs,
    scenarios,
    scene_imports,
    scenes,
    server,
    sessions,
    ui,
    view,
)
from .worker import Worker

PROTECTED: tuple[APIRouter, ...] = (
    server.router,
    scenes.router,
    scene_imports.router,
    scenarios.router,
    assets.router,
    jobs.router,
    exports.router,
)
"""Routers behind the worker's token."""

OPEN: tuple[APIRouter, ...] = (
    health.router,
    sessions.router,
    drive.router,
    view.router,
    ui.router,
)
"""Routers that ask for a token themselves, where they want one."""


def create_app(settings: Settings) -> FastAPI:
    """The application of one worker; it starts and stops with the application's lifespan.

    Raises:
        RenderError: the backend of the settings cannot be used here.
    """
    worker = Worker.build(settings)

    @asynccontextmanager
    async def lifespan(_app: FastAPI) -> AsyncIterator[None]:
        async with worker.running():
            app.openapi_schema = await asyncio.to_thread(published, app)
            yield

    app = FastAPI(
        title="Real2Sim worker",
        version=version("real2sim"),
        lifespan=lifespan,
        generate_unique_id_function=operation_id,
        responses={"default": {"model": Problem, "description": "problem+json (RFC 9457)"}},
        redoc_url=None,
    )
    app.state.worker = worker
    upload_paths = (*scene_imports.UPLOAD_PATHS, assets.UPLOAD_PATH)
    uploads = dict.fromkeys(upload_paths, settings.max_upload_bytes)
    install_problem_handlers(app)
    app.add_middleware(BodyLimit, limit=settings.max_request_bytes, uploads=uploads)
    if settings.token is None:
        app.add_middleware(LoopbackOnly)
    app.add_middleware(RequestContext, metrics=worker.metrics)
    for router in OPEN:
        app.include_router(router)
    for router in PROTECTED:
        app.include_router(router, dependencies=[Depends(require_token)])
    return app


def operation_id(route: APIRoute) -> str:
    """Name of a call in OpenAPI, stable as long as its function's name is: ``scenes-render``."""
    subject = str(route.tags[0]) if route.tags else "worker"
    return f"{subject}-{route.name}"
