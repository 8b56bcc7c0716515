"""Spans of requests and engine jobs, as a collector receives them."""

from __future__ import annotations

import http.client
import re

import pytest

from real2sim_server.service.app import create_app, trace
from real2sim_server.service.http.telemetry import provider_of
from tests.waiting import LIMIT_S

from .test_placement import site  # noqa: F401, a fixture

sdk = pytest.importorskip("opentelemetry.sdk.trace.export", reason="an extra: tracing")

PARENT = "00-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01"


@pytest.fixture
def spans(make_settings):
    """A traced worker and its exporter."""
    from fastapi.testclient import TestClient
    from opentelemetry.sdk.trace.export.in_memory_span_exporter import InMemorySpanExporter

    exporter, provider = InMemorySpanExporter(), provider_of("w0")
    provider.add_span_processor(sdk.SimpleSpanProcessor(exporter))
    app = create_app(make_settings())
    trace(app, app.state.worker, provider)
    with TestClient(app, base_url="http://127.0.0.1") as client:
        yield client, exporter
    provider.shutdown()


def test_request_and_engine_spans_continue_the_trace_of_the_caller(spans):
    client, exporter = spans
    path = "/v1/scenes/tiny/render?width=64"
    assert client.get(path, headers={"traceparent": PARENT}).status_code == 200
    client.get("/v1/scenes")
    found = {span.name: span for span in exporter.get_finished_spans()}
    request = found["GET /v1/scenes/{scene}/render"]
    assert f"{request.context.trace_id:032x}" == PARENT.split("-")[1]
    assert f"{request.parent.span_id:016x}" == PARENT.split("-")[2]
    assert request.attributes["http.response.status_code"] == 200
    assert request.attributes["real2sim.scene"] == "tiny"
    engine = [span for name, span in found.items() if name.startswith("engine ")]
    assert engine
    assert {span.parent.span_id for span in engine} == {request.context.span_id}
    assert all(span.start_time <= span.end_time for span in engine)
    # A request without a parent starts a new trace.
    assert found["GET /v1/scenes"].context.trace_id != request.context.trace_id


def test_health_and_metrics_produce_no_spans(spans):
    client, exporter = spans
    client.get("/livez")
    client.get("/metrics")
    assert exporter.get_finished_spans() == ()


def test_an_untraced_worker_has_no_tracing_hook(client):
    assert client.app.state.worker.engine.on_queued is None


@pytest.mark.network
def test_the_proxy_starts_a_trace_if_there_is_none(site):  # noqa: F811
    seen: list[str] = []
    web = site.stands["w0"].web.RequestHandlerClass
    plain = web.do_GET

    def do_get(handler) -> None:
        seen.append(handler.headers.get("traceparent", ""))
        plain(handler)

    web.do_GET = do_get
    site.ask("/v1/sessions/w0.7f/state")
    connection = http.client.HTTPConnection(site._address, timeout=LIMIT_S)
    connection.request("GET", "/v1/sessions/w0.7f/state", headers={"traceparent": PARENT})
    connection.getresponse().read()
    connection.close()
    begun, given = [s for s in seen if s][-2:]
    assert re.fullmatch(r"00-[0-9a-f]{32}-[0-9a-f]{16}-01", begun)
    assert given == PARENT
