"""Connection errors that are retried."""

from __future__ import annotations

import pytest

import real2sim
from real2sim._session_state import is_away, is_transient
from real2sim._sync.transport import outlast, reconnect
from real2sim.errors import ErrorDetails, error_for


@pytest.mark.parametrize(
    ("status", "code", "passes"),
    [
        (502, "UNKNOWN", True),
        (503, "UNKNOWN", True),
        (503, "SESSION_ELSEWHERE", True),
        (504, "TIMEOUT", True),
        (507, "OUT_OF_MEMORY", True),
        (401, "UNAUTHORIZED", False),
        (404, "UNKNOWN_SESSION", False),
        (410, "SESSION_CLOSED", False),
        (500, "INTERNAL", False),
    ],
)
def test_transient_errors_are_recognised(status, code, passes):
    assert is_transient(error_for(ErrorDetails(status, code, "no"))) == passes


def test_reconnecting_retries_until_the_worker_is_back(monkeypatch):
    bad_gateway = error_for(ErrorDetails(502, "UNKNOWN", "bad gateway"))
    monkeypatch.setattr("real2sim._sync.transport.sleep", lambda _seconds: None)
    outcomes = [real2sim.UnreachableError("nobody"), bad_gateway, None]

    def connect() -> None:
        if (error := outcomes.pop(0)) is not None:
            raise error

    reconnect(lambda: None, connect, seconds=60.0)
    assert not outcomes


def test_a_refusal_is_not_retried():
    def connect() -> None:
        raise error_for(ErrorDetails(410, "SESSION_CLOSED", "it is over"))

    with pytest.raises(real2sim.SessionClosedError):
        reconnect(lambda: None, connect, seconds=60.0)


@pytest.mark.parametrize(
    ("status", "code"), [(503, "STORAGE_UNAVAILABLE"), (503, "UNKNOWN")], ids=["worker", "proxy"]
)
def test_an_unavailable_store_is_retried(monkeypatch, status, code):
    monkeypatch.setattr("real2sim._sync.transport.sleep", lambda _seconds: None)
    away = error_for(ErrorDetails(status, code, "away"))
    outcomes = [away, away, "obs"]

    def ask() -> str:
        found = outcomes.pop(0)
        if isinstance(found, Exception):
            raise found
        return found

    assert outlast(ask, seconds=60.0, passes=is_away) == "obs"
    assert not outcomes


@pytest.mark.parametrize(
    ("code", "seconds"), [("STORAGE_UNAVAILABLE", 0.0), ("TOO_MANY_SESSIONS", 60.0)]
)
def test_zero_seconds_or_a_capacity_error_means_no_retry(code, seconds):
    asked = []

    def ask() -> None:
        asked.append(1)
        raise error_for(ErrorDetails(503, code, "no"))

    with pytest.raises(real2sim.CapacityError):
        outlast(ask, seconds=seconds, passes=is_away)
    assert len(asked) == 1
