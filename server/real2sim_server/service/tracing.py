"""Spans of requests and of what the engine does for them, by OpenTelemetry; off unless a collector
is named (``REAL2SIM_TRACES_URL``).

A request continues the trace that its ``traceparent`` names, which the shipped proxy gives to those
without, so that the proxy's log, the worker's and the spans have the same id.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from starlette.types import ASGIApp, Message, Receive, Scope, Send

if TYPE_CHECKING:
    from opentelemetry.sdk.trace import TracerProvider

OnEngine = Callable[[str, float, float], None]
"""Told the label of a job, and the seconds that it waited and ran, at its end."""

_QUIET = ("/livez", "/readyz", "/metrics")


def traces_to(url: str, *, worker_id: str) -> TracerProvider:
    """Spans that are sent to a collector, in batches, on a thread of their own.

    Args:
        url: of the collector, which speaks OTLP by HTTP, as ``http://host:4318/v1/traces``.
        worker_id: of this worker.

    Raises:
        ValueError: the extra ``tracing`` is not installed.
    """
    try:
        from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
        from opentelemetry.sdk.trace.export import BatchSpanProcessor
    except ImportError as error:
        raise ValueError(
            "REAL2SIM_TRACES_URL needs OpenTelemetry: pip install 'real2sim[tracing]'"
        ) from error
    provider = provider_of(worker_id)
    provider.add_span_processor(BatchSpanProcessor(OTLPSpanExporter(endpoint=url)))
    return provider


def provider_of(worker_id: str) -> TracerProvider:
    """Where spans of a worker come together; they go nowhere yet."""
    from opentelemetry.sdk.resources import Resource
    from opentelemetry.sdk.trace import TracerProvider

    about = {"service.name": "real2sim", "service.instance.id": worker_id}
    return TracerProvider(resource=Resource.create(about))


class Tracing:
    """ASGI middleware: a span for each request, under which those of the engine are.

    Args:
        app: the application.
        provider: of spans.
    """

    def __init__(self, app: ASGIApp, *, provider: TracerProvider) -> None:
        self._app = app
        self._tracer = provider.get_tracer("real2sim")

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one connection."""
        if scope["type"] not in ("http", "websocket") or scope["path"] in _QUIET:
            await self._app(scope, receive, send)
            return
        from opentelemetry import trace
        from opentelemetry.trace.propagation.tracecontext import TraceContextTextMapPropagator

        headers = {name.decode("latin-1"): v.decode("latin-1") for name, v in scope["headers"]}
        above = TraceContextTextMapPropagator().extract(headers)
        method = scope.get("method", "WEBSOCKET")

        with self._tracer.start_as_current_span(
            method, context=above, kind=trace.SpanKind.SERVER
        ) as span:

            async def send_noted(message: Message) -> None:
                if message["type"] == "http.response.start":
                    span.set_attribute("http.response.status_code", message["status"])
                await send(message)

            try:
                await self._app(scope, receive, send_noted)
            finally:
                route = getattr(scope.get("route"), "path", None) or "unmatched"
                span.update_name(f"{method} {route}")
                for name, value in _about(scope, method, route).items():
                    span.set_attribute(name, value)


def engine_spans(provider: TracerProvider) -> Callable[[], OnEngine | None]:
    """For :class:`.engine.Engine`: asked where a job is put in the queue, its answer is called when
    the job is over, on the engine's thread.

    Args:
        provider: of spans.
    """
    from opentelemetry import trace

    tracer = provider.get_tracer("real2sim")

    def begin() -> OnEngine | None:
        above = trace.get_current_span()
        if not above.get_span_context().is_valid:
            return None
        context = trace.set_span_in_context(above)

        def end(label: str, waited_s: float, ran_s: float) -> None:
            now = time.time_ns()
            began = now - round((waited_s + ran_s) * 1e9)
            span = tracer.start_span(f"engine {label}", context=context, start_time=began)
            span.set_attribute("real2sim.queue_wait_s", waited_s)
            span.end(end_time=now)

        return end

    return begin


def _about(scope: Scope, method: str, route: str) -> dict[str, Any]:
    found = {"http.request.method": method, "http.route": route, "url.path": scope["path"]}
    for name in ("session_id", "scenario_id", "job_id", "scene"):
        if value := (scope.get("path_params") or {}).get(name):
            found[f"real2sim.{name}"] = str(value)
    return found
