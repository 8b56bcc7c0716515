"""What each request and socket moves, and whose account that goes to."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from starlette.requests import HTTPConnection
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from ..accounts import PAYER, Account, Payer
from .roles import check_role
from .websocket import EXTENSION, TAKING, Part, Taker

USAGE_KEY = "real2sim.usage"


@dataclass(eq=False)
class Usage:
    """What one connection has moved.

    Attributes:
        account: that it goes to; None until the token was looked at.
        received, sent: bytes that no account has got yet.
    """

    account: Account | None = None
    received: int = 0
    sent: int = 0

    def pay(self) -> None:
        """Hand over to the account what was moved, as far as it is known."""
        if self.account is not None:
            self.account.received_bytes += self.received
            self.account.sent_bytes += self.sent
            self.received = self.sent = 0


def usage_of(scope: Scope) -> Usage:
    """Of a request or a socket."""
    found = scope.get(USAGE_KEY)
    return found if isinstance(found, Usage) else Usage()


def begin_paying(connection: HTTPConnection, account: Account) -> None:
    """From now on all that the running task does is counted for ``account``.

    Raises:
        RevokedError: its token is no more.
        OverLimitError: it has had its requests or bytes.
        ServiceError: FORBIDDEN: its role does not allow it.
    """
    usage_of(connection.scope).account = account
    check_role(connection, account.role, name=account.name)
    account.admit()
    PAYER.set(Payer(account))


class Accounting:
    """ASGI middleware that counts bytes of bodies and messages."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one connection."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        usage = scope[USAGE_KEY] = Usage()

        async def counted_receive() -> Message:
            message = await receive()
            usage.received += _size(message)
            usage.pay()
            return message

        async def counted_send(message: Message) -> None:
            usage.sent += _size(message)
            usage.pay()
            await send(message)

        extensions = scope.get("extensions") or {}
        if EXTENSION in extensions:
            extensions[EXTENSION] = _counted_parts(extensions[EXTENSION], usage)
        if TAKING in extensions:
            extensions[TAKING] = _counted_taking(extensions[TAKING], usage)
        try:
            await self._app(scope, counted_receive, counted_send)
        finally:
            usage.pay()


def _counted_parts(
    send_parts: Callable[[Sequence[Part]], bool], usage: Usage
) -> Callable[[Sequence[Part]], bool]:
    def counted(parts: Sequence[Part]) -> bool:
        sent = send_parts(parts)
        if sent:
            usage.sent += sum(map(len, parts))
            usage.pay()
        return sent

    return counted


def _counted_taking(offer: Callable[[Taker | None], None], usage: Usage) -> Callable[[Taker], None]:
    def offered(taker: Taker) -> None:
        def counted(data: bytes) -> bool:
            taken = taker(data)
            if taken:
                usage.received += len(data)
                usage.pay()
            return taken

        offer(counted)

    return offered


def _size(message: Message) -> int:
    return len(message.get("body") or message.get("bytes") or message.get("text") or b"")
