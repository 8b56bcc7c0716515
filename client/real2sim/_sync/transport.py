# Made from _async/transport.py by scripts/unasync.py; edit that file, then run the script.
"""Sends calls and waits for their answers."""

from __future__ import annotations

from typing import TypeVar

import httpx2

from .._call import Call, Request
from .._http import Attempts, accepted_reply, client_options, http_errors, request_options
from .._replies import Reply
from .._target import Target
from ..errors import Real2SimError
from .concurrency import sleep

T = TypeVar("T")


class Transport:
    """The way to one worker."""

    def __init__(self, target: Target, *, transport: httpx2.BaseTransport | None = None) -> None:
        self.target = target
        self._http = httpx2.Client(transport=transport, **client_options(target))

    def send(self, call: Call[T]) -> T:
        """The parsed answer; retried where that is safe.

        Raises:
            Real2SimError: no answer, or the worker refuses.
        """
        attempts = Attempts(self.target.policy, call.request)
        while True:
            try:
                return call.parse(self._exchange(call.request))
            except Real2SimError as error:
                delay = attempts.delay_after(error)
                if delay is None:
                    # The caller's lines say where it happened; those below are always the same.
                    raise error.with_traceback(None) from error.__cause__
            sleep(delay)

    def _exchange(self, request: Request) -> Reply:
        with http_errors(self.target, request), request_options(self.target, request) as options:
            response = self._http.request(request.method, request.path, **options)
        return accepted_reply(response, request)

    def close(self) -> None:
        """Close the connections."""
        self._http.close()
