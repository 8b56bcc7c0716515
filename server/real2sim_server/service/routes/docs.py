"""The reference of calls: a page for persons, made once."""

from __future__ import annotations

from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse

from ..http.openapi import POLICY, published, reference_page

router = APIRouter(include_in_schema=False)


@router.get("/docs")
async def docs(request: Request) -> HTMLResponse:
    """Every call with its parameters, answers and an example."""
    page = reference_page(published(request.app))
    return HTMLResponse(page, headers={"Content-Security-Policy": POLICY})
