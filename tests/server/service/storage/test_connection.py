"""Database connections and their cleanup on failure."""

from __future__ import annotations

import gc
import socket
import sqlite3
import subprocess
import sys
import warnings
from contextlib import closing

import pytest

from real2sim_server.service.storage.connection import connect, make_private

pytestmark = pytest.mark.network


def test_a_connection_timeout_leaves_no_socket_open():
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


def test_setting_permissions_keeps_the_journal_of_an_open_database(tmp_path):
    """Closing another descriptor of the file would release this process's locks on it."""
    file = tmp_path / "store.db"
    with closing(sqlite3.connect(file)) as store:
        store.execute("PRAGMA journal_mode=WAL")
        store.execute("CREATE TABLE kept (x)")
        make_private(file)
        # The last connection removes the journal on close. This is not the last one.
        leave = "import sqlite3, sys; sqlite3.connect(sys.argv[1]).execute('SELECT * FROM kept')"
        subprocess.run([sys.executable, "-c", leave, str(file)], check=True)
        assert file.with_name("store.db-wal").exists()
