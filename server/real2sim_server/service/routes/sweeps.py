"""Sweeps and searches: many variants of a case, driven by planners."""

from __future__ import annotations

from fastapi import APIRouter, Request, Response

from real2sim_proto.jobs import JobInfo
from real2sim_proto.sweeps import SweepRequest

from ..http.auth import TokenRoute
from ..http.idempotency import IdempotencyKey
from ..http.requests import ClientName
from ..http.responses import info_response
from ..jobs.jobs import accepted_headers
from ..worker import WorkerOf

router = APIRouter(prefix="/v1/sweeps", tags=["sweeps"], route_class=TokenRoute)


@router.post("", status_code=202, response_model=JobInfo)
async def create(
    worker: WorkerOf,
    body: SweepRequest,
    request: Request,
    idempotency_key: IdempotencyKey = None,
    who: ClientName = "",
) -> Response:
    """Drive points of a parameter space with planners, or search it for a planner's avoidable
    failures (`method` of kind `search`); the answer is a job. Once it has succeeded,
    `GET /v1/jobs/{id}/files/episodes.parquet` has a row an episode, and the `worst` of the result
    left `EPISODE.r2e` and, of a scenario, `EPISODE.xosc`. A search leaves `failures.json`,
    `failures.tar` with its page, and each failure as `failure_01.xosc` and `.r2e`."""
    async with worker.idempotency.guard(request, idempotency_key) as idempotent:
        if idempotent.replay:
            return worker.replayed(idempotent.replay)
        info = await worker.sweeps.start(body, who=who, idempotent=idempotent)
        return info_response(info, status=202, headers=accepted_headers(info))
