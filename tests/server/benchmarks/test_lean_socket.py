"""The bench's own WebSocket client against the library's server."""

from __future__ import annotations

import contextlib
import os
import select
import threading
from collections.abc import Callable, Iterator

import pytest
from websockets.exceptions import ConnectionClosed, InvalidHandshake
from websockets.sync.server import ServerConnection, serve

from real2sim_bench import drive_probe
from real2sim_bench.drive_probe import LeanSocket
from tests.waiting import LIMIT_S, wait_until

SUBPROTOCOL = "bench.v1"


@contextlib.contextmanager
def server(talk: Callable[[ServerConnection], None], *, speaks: str = SUBPROTOCOL) -> Iterator[str]:
    options = {"subprotocols": [speaks], "compression": None, "max_size": None}
    with serve(talk, "127.0.0.1", 0, **options) as listening:
        thread = threading.Thread(target=listening.serve_forever, daemon=True)
        thread.start()
        yield f"ws://127.0.0.1:{listening.socket.getsockname()[1]}/drive"
        listening.shutdown()
    thread.join()


def echo(connection: ServerConnection) -> None:
    for message in connection:
        connection.send(message)


@pytest.mark.parametrize("size", [0, 1, 125, 126, 65_535, 65_536, 1_500_000])
def test_messages_of_any_length_are_echoed_unchanged(size):
    message = os.urandom(size)
    with server(echo) as url, LeanSocket(url, subprotocol=SUBPROTOCOL) as lean:
        for _ in range(2):
            lean.send(message)
            assert bytes(lean.recv(LIMIT_S)) == message


def test_messages_received_together_are_separated():
    sent = [os.urandom(n) for n in (10, 70_000, 3, 200)]

    def talk(connection: ServerConnection) -> None:
        connection.recv()
        for message in sent:
            connection.send(message)
        connection.recv()

    with server(talk) as url, LeanSocket(url, subprotocol=SUBPROTOCOL) as lean:
        lean.send(b"go")
        assert [bytes(lean.recv(LIMIT_S)) for _ in sent] == sent
        lean.send(b"done")


def test_a_fragmented_message_is_reassembled():
    def talk(connection: ServerConnection) -> None:
        connection.send(iter([b"one ", b"two ", b"three"]))
        connection.recv()

    with server(talk) as url, LeanSocket(url, subprotocol=SUBPROTOCOL) as lean:
        assert bytes(lean.recv(LIMIT_S)) == b"one two three"
        lean.send(b"done")


def test_a_ping_of_the_server_is_answered_before_the_next_message():
    answered = threading.Event()

    def talk(connection: ServerConnection) -> None:
        pong = connection.ping()
        connection.send(b"after")
        if pong.wait(LIMIT_S):
            answered.set()
        connection.recv()

    with server(talk) as url, LeanSocket(url, subprotocol=SUBPROTOCOL) as lean:
        assert bytes(lean.recv(LIMIT_S)) == b"after"
        assert answered.wait(LIMIT_S)
        lean.send(b"done")


def test_a_ping_of_the_client_is_answered():
    with server(echo) as url, LeanSocket(url, subprotocol=SUBPROTOCOL) as lean:
        assert lean.ping(LIMIT_S) > 0


def test_receiving_works_after_a_timeout():
    with server(echo) as url, LeanSocket(url, subprotocol=SUBPROTOCOL) as lean:
        with pytest.raises(TimeoutError):
            lean.recv(0.05)
        lean.send(b"late")
        assert bytes(lean.recv(LIMIT_S)) == b"late"


def test_a_started_message_uses_the_stall_timeout():
    """The timeout of ``recv`` only applies to the start of a message."""
    waits_longer = threading.Event()

    def talk(connection: ServerConnection) -> None:
        connection.send(in_two_parts())
        connection.recv()

    def in_two_parts() -> Iterator[bytes]:
        yield b"one "
        waits_longer.wait(LIMIT_S)
        yield b"two"

    class Watched(LeanSocket):
        def _exactly(self, size: int) -> bytearray:
            if self.socket.gettimeout() == drive_probe.STALLED_S:
                waits_longer.set()
            return super()._exactly(size)

    with server(talk) as url, Watched(url, subprotocol=SUBPROTOCOL) as lean:
        wait_until(lambda: select.select([lean.socket], [], [], 0)[0], "the first part")
        assert bytes(lean.recv(0.2)) == b"one two"
        assert waits_longer.is_set()
        lean.send(b"done")


def test_a_server_that_stalls_within_a_message_raises(monkeypatch):
    monkeypatch.setattr(drive_probe, "STALLED_S", 0.05)
    go_on = threading.Event()

    def talk(connection: ServerConnection) -> None:
        def parts() -> Iterator[bytes]:
            yield b"one "
            go_on.wait(LIMIT_S)
            yield b"two"

        with contextlib.suppress(ConnectionClosed):
            connection.send(parts())

    with server(talk) as url, LeanSocket(url, subprotocol=SUBPROTOCOL) as lean:
        with pytest.raises(ConnectionError, match="within a message"):
            lean.recv(LIMIT_S)
        go_on.set()


def test_a_closed_connection_raises_with_the_reason():
    with (
        server(lambda connection: connection.close(1000, "enough")) as url,
        LeanSocket(url, subprotocol=SUBPROTOCOL) as lean,
        pytest.raises(ConnectionError, match="enough"),
    ):
        lean.recv(LIMIT_S)


def test_another_subprotocol_is_refused_at_the_handshake():
    with server(echo, speaks="other.v1") as url, pytest.raises(InvalidHandshake):
        LeanSocket(url, subprotocol=SUBPROTOCOL)
