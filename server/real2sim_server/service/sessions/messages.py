"""Messages of clients, read strictly."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from pydantic import ValidationError

from real2sim_proto import (
    PROTOCOL_VERSION,
    CodecError,
    ErrorCode,
    decode,
    protocol_mismatch,
)
from real2sim_proto.codec import MAX_CLIENT_MESSAGE_BYTES, unpack
from real2sim_proto.drive import CLIENT_MESSAGE, Action, ClientMessage

from ..._records import made_quickly
from ...world.recording.replay import plan_payload
from ..http.problems import ServiceError

MAX_PROBLEMS = 4
TYPES = "hello, attach, reset, action, edit, render, agent, snapshot, restore, fork, bye"


@made_quickly
@dataclass(frozen=True)
class ReceivedMessage:
    """One message of a client.

    Attributes:
        message: as its model.
        content: canonical bytes of an action's plan; empty for other messages.
    """

    message: ClientMessage
    content: bytes = b""


@made_quickly
@dataclass(frozen=True)
class ReceivedAction(ReceivedMessage):
    """An action of a client."""

    message: Action


class BadMessageError(Exception):
    """A message that is refused before anybody looks at what it wants.

    Attributes:
        error: sent to the client.
        message_id: of the message, as far as it could be read.
        fatal: whether there is no sense in going on.
    """

    def __init__(self, error: ServiceError, *, message_id: int = 0, fatal: bool = False) -> None:
        super().__init__(error.detail)
        self.error = error
        self.message_id = message_id
        self.fatal = fatal


def read_message(data: bytes) -> ReceivedMessage:
    """The message in ``data``.

    Raises:
        BadMessageError: not a message; one of another protocol version is fatal.
    """
    if (action := action_in(data)) is not None:
        return action
    message = _read(data)
    content = plan_payload(message.plan) if isinstance(message, Action) else b""
    return ReceivedMessage(message, content)


def action_in(data: bytes) -> ReceivedAction | None:
    """An action, by far the commonest of messages; None for anything else and for whatever has to
    be refused. Nobody looks at each of its values twice: its model leaves no place for any that
    the wire does not carry."""
    try:
        fields = unpack(data)
        if fields["type"] == "action" and type(fields["v"]) is int:
            message = CLIENT_MESSAGE.validator.validate_python(fields)
            if isinstance(message, Action):
                return ReceivedAction(message, plan_payload(message.plan))
    except Exception:
        # Found out once more, where it is said what is wrong.
        return None
    return None


def _read(data: bytes) -> ClientMessage:
    """The message in ``data``. Raises as :func:`read_message` does."""
    try:
        fields = decode(data, max_bytes=MAX_CLIENT_MESSAGE_BYTES)
    except CodecError as error:
        raise BadMessageError(bad_message(str(error))) from error
    message_id = _id_of(fields)
    version = fields.get("v", PROTOCOL_VERSION)
    # An array would be compared value by value.
    if type(version) is not int or version != PROTOCOL_VERSION:
        detail = (
            f"the message has protocol version {version!r}; this worker speaks {PROTOCOL_VERSION}. "
            "Install a client and a worker of the same major version."
        )
        mismatch = ServiceError(ErrorCode.UNSUPPORTED_PROTOCOL, detail)
        raise BadMessageError(mismatch, message_id=message_id, fatal=True)
    try:
        return CLIENT_MESSAGE.validate_python(fields)
    except ValidationError as error:
        raise BadMessageError(
            bad_message(validation_summary(error)), message_id=message_id
        ) from error


def bad_message(detail: str) -> ServiceError:
    """BAD_MESSAGE."""
    return ServiceError(
        ErrorCode.BAD_MESSAGE, detail, hint=f"messages are msgpack maps with a type: {TYPES}"
    )


def unsupported_protocol(offered: list[str]) -> ServiceError:
    """UNSUPPORTED_PROTOCOL, naming what both sides speak."""
    return ServiceError(ErrorCode.UNSUPPORTED_PROTOCOL, protocol_mismatch(offered))


def _id_of(fields: dict[str, Any]) -> int:
    given = fields.get("id", 0)
    return given if type(given) is int and 0 <= given <= 2**53 else 0


def validation_summary(error: ValidationError) -> str:
    """What is wrong and where: ``action/plan/poses/0/1: input should be a finite number``."""
    found = error.errors(include_url=False, include_context=False)
    texts = []
    for problem in found[:MAX_PROBLEMS]:
        place = "/".join(str(part) for part in problem["loc"]) or "message"
        given = repr(problem["input"])
        shown = f" (given: {given})" if len(given) <= 60 else ""
        texts.append(f"{place}: {problem['msg']}{shown}")
    more = f"; and {len(found) - MAX_PROBLEMS} more" if len(found) > MAX_PROBLEMS else ""
    return "; ".join(texts) + more
