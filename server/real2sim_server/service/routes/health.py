"""Whether the worker lives, whether it is ready, and how it does."""

from __future__ import annotations

from fastapi import APIRouter, Depends, Response

from real2sim_proto import ErrorCode
from real2sim_proto.scenes import Readiness

from ..http.auth import require_token
from ..http.problems import ServiceError
from ..worker import WorkerOf

router = APIRouter(tags=["health"])


@router.get(
    "/livez",
    responses={503: {"model": dict[str, str], "description": "dead or stalled, and why"}},
)
async def live(worker: WorkerOf, response: Response) -> dict[str, str]:
    """200 while the engine thread shows signs of life; at 503 only a restart helps."""
    engine = worker.engine
    if not engine.alive:
        response.status_code = 503
        return {"status": "dead", "reason": f"engine: {engine.failure or 'its thread has ended'}"}
    if engine.seconds_since_tick > worker.settings.stall_seconds:
        response.status_code = 503
        reason = f"job {engine.running!r} runs for {engine.seconds_since_tick:.0f} s"
        return {"status": "stalled", "reason": reason}
    return {"status": "alive"}


@router.get("/readyz", responses={503: {"model": Readiness, "description": "not ready"}})
async def ready(worker: WorkerOf, response: Response) -> Readiness:
    """200 when new work is welcome; otherwise 503 with the reasons."""
    readiness = worker.readiness()
    if not readiness.ready:
        response.status_code = 503
        response.headers["Retry-After"] = "1"
    return readiness


@router.get("/metrics", dependencies=[Depends(require_token)], response_class=Response)
async def metrics(worker: WorkerOf) -> Response:
    """Prometheus metrics."""
    if not worker.settings.metrics:
        raise ServiceError(ErrorCode.NOT_FOUND, "metrics are turned off by REAL2SIM_METRICS")
    body, media_type = await worker.metrics.exposition()
    return Response(body, media_type=media_type)
