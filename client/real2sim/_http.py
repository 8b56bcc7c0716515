"""How a request becomes HTTP and what its failures become, whoever waits for it."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import httpx2

from ._call import Request
from ._replies import Reply, error_from_reply
from ._retry import RETRYABLE_CODES, RETRYABLE_STATUS, RetryPolicy
from ._target import Target
from .errors import Real2SimError, ReplyTimeoutError, StatusError, UnreachableError

UNREACHABLE_HINT = "start a worker with `real2sim serve`, or check the address"


def client_options(target: Target) -> dict[str, Any]:
    """Arguments of an HTTP client for a worker."""
    # A proxy that the environment names cannot reach a worker on this machine.
    return {
        "base_url": target.url,
        "headers": target.headers,
        "timeout": target.timeout,
        "trust_env": not target.loopback,
    }


@contextlib.contextmanager
def request_options(target: Target, request: Request) -> Iterator[dict[str, Any]]:
    """Arguments of one request; a file that it uploads is open for the length of the block."""
    options: dict[str, Any] = {
        "params": request.params,
        "headers": request.headers,
        "content": request.body,
        "timeout": timeout_of(target, request),
    }
    if request.upload is None:
        yield options
        return
    with request.upload.open("rb") as file:
        yield options | {"data": request.form, "files": {"file": (request.upload.name, file)}}


@contextlib.contextmanager
def http_errors(target: Target, request: Request) -> Iterator[None]:
    """What goes wrong on the way, as errors of the SDK; the library's own would say no more."""
    try:
        yield
    except httpx2.ConnectTimeout:
        raise ReplyTimeoutError(
            f"connection to {target.url}", timeout_of(target, request), hint=UNREACHABLE_HINT
        ) from None
    except httpx2.TimeoutException:
        raise ReplyTimeoutError(
            f"reply to {request} from {target.url}",
            timeout_of(target, request),
            hint="the worker may be busy; see `real2sim status`, or give a longer timeout",
        ) from None
    except httpx2.ConnectError as error:
        raise UnreachableError(
            f"no worker answers at {target.url}: {error}", hint=UNREACHABLE_HINT
        ) from None
    except httpx2.TransportError as error:
        raise UnreachableError(
            f"the connection to {target.url} broke during {request}: {error or type(error)}",
        ) from error


def timeout_of(target: Target, request: Request) -> float:
    """Seconds that the reply may take."""
    return target.long_timeout if request.long_timeout else target.timeout


def accepted_reply(response: httpx2.Response, request: Request) -> Reply:
    """The reply in a response. Raises Real2SimError where the worker refuses the request."""
    headers = {name.lower(): value for name, value in response.headers.items()}
    reply = Reply(response.status_code, headers, response.content)
    # A proxy may answer with the same status in words of its own.
    expected = reply.status in request.accepted and reply.media_type == "application/json"
    if reply.status >= 300 and not expected:
        raise error_from_reply(reply)
    return reply


class Attempts:
    """Counts the tries of one request."""

    def __init__(self, policy: RetryPolicy, request: Request) -> None:
        self._policy = policy
        self._request = request
        self._made = 0

    def delay_after(self, error: Real2SimError) -> float | None:
        """Seconds until the next try; None where there is none."""
        attempt, self._made = self._made, self._made + 1
        # Who has waited long already would only add work to a worker that is slow.
        waited = self._request.long_timeout and isinstance(error, ReplyTimeoutError)
        if not self._request.idempotent or waited or not _is_transient(error):
            return None
        retry_after = error.retry_after if isinstance(error, StatusError) else None
        return self._policy.delay(attempt, retry_after=retry_after)


def _is_transient(error: Real2SimError) -> bool:
    if isinstance(error, StatusError):
        return error.status in RETRYABLE_STATUS or error.code in RETRYABLE_CODES
    return isinstance(error, UnreachableError | ReplyTimeoutError)
