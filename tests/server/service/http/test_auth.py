from __future__ import annotations

import pytest

from real2sim_proto import ErrorCode
from real2sim_server.service.http.auth import OpenBindError, check_bind

TOKEN = "correct horse battery"


def bearer(token: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {token}"}


@pytest.fixture
def guarded(start_worker):
    return start_worker(token=TOKEN)


@pytest.mark.parametrize("path", ["/livez", "/readyz"])
def test_health_is_open(guarded, path):
    assert guarded.get(path).status_code != 401


@pytest.mark.parametrize("path", ["/v1/server", "/v1/scenes", "/v1/scenarios", "/metrics"])
def test_all_other_routes_require_the_token(guarded, path):
    response = guarded.get(path)
    assert response.status_code == 401
    assert response.json()["code"] == ErrorCode.UNAUTHORIZED
    assert response.headers["WWW-Authenticate"] == "Bearer"
    assert guarded.get(path, headers=bearer(TOKEN)).status_code == 200


@pytest.mark.parametrize(
    "header", ["Bearer wrong", "Bearer", "Basic Y29ycmVjdA==", f"Bearer {TOKEN}x", "Bearer \u00e9"]
)
def test_any_other_credential_is_refused(guarded, header):
    headers = {"Authorization": header.encode("latin-1")}
    assert guarded.get("/v1/server", headers=headers).status_code == 401


def test_a_worker_without_a_token_requires_no_authentication(client):
    assert client.get("/v1/server").status_code == 200


@pytest.mark.parametrize("host", ["127.0.0.1", "127.8.8.8", "::1", "localhost"])
def test_loopback_addresses_need_no_token(host):
    check_bind(host, None)


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.168.1.7", "worker.example", ""])
def test_other_addresses_require_a_token(host):
    with pytest.raises(OpenBindError, match="REAL2SIM_TOKEN"):
        check_bind(host, None)
    check_bind(host, TOKEN)
