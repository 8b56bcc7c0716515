"""How a database is reached, and what is left where it is not."""

from __future__ import annotations

import gc
import socket
import warnings

import pytest

from real2sim_server.service.storage.connection import connect

pytestmark = pytest.mark.network


def test_a_server_that_answers_nothing_leaves_no_socket_open():
    pytest.importorskip("pg8000", reason="the driver is not installed: pip install 'real2sim[dev]'")
    with socket.create_server(("127.0.0.1", 0)) as silent:
        port = silent.getsockname()[1]
        engine = connect(f"postgresql+pg8000://someone@127.0.0.1:{port}/none", timeout_s=0.2)
        with warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always", ResourceWarning)
            with pytest.raises(Exception, match="timed out"):
                engine.connect()
            gc.collect()
    assert [str(w.message) for w in warned if w.category is ResourceWarning] == []
