from __future__ import annotations

import http.client
import uuid
from collections.abc import Iterator

import pytest


@pytest.fixture(scope="session")
def s3_server() -> Iterator[int]:
    """Port of a local S3-compatible object store."""
    server_of = pytest.importorskip("moto.server", reason="needs moto: pip install 'real2sim[dev]'")
    pytest.importorskip("obstore", reason="needs obstore: pip install 'real2sim[objects]'")
    server = server_of.ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    yield server.get_host_and_port()[1]
    server.stop()


@pytest.fixture(params=["file", "s3"])
def objects_url(request, tmp_path, monkeypatch) -> str:
    """URL of an empty object store of each kind."""
    if request.param == "file":
        return f"file://{tmp_path / 'objects'}"
    port: int = request.getfixturevalue("s3_server")
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "tests")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "tests")
    bucket = f"test-{uuid.uuid4().hex}"
    connection = http.client.HTTPConnection("127.0.0.1", port)
    connection.request("PUT", f"/{bucket}")
    assert connection.getresponse().status == 200
    connection.close()
    return f"s3://{bucket}/fleet?endpoint=http://127.0.0.1:{port}&region=us-east-1"
