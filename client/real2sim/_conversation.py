"""The client's side of the drive socket, without the socket.

Both twins of the drive session talk through a :class:`Conversation`: it numbers messages, says
which answer is awaited, and turns bytes into answers or exceptions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from pydantic import ValidationError

from real2sim_proto import (
    HTTP_STATUS,
    PROTOCOL_VERSION,
    SUPPORTED_SUBPROTOCOLS,
    CodecError,
    ErrorCode,
    decode,
    encode,
)
from real2sim_proto.drive import (
    PLAN,
    SERVER_MESSAGE,
    Action,
    Bye,
    Edit,
    Edited,
    Envelope,
    Error,
    Hello,
    Obs,
    Plan,
    Progress,
    Render,
    Reset,
    ResetSpec,
    Result,
    SensorSpec,
    View,
    Welcome,
)
from real2sim_proto.operations import Operation

from ._replies import describe
from ._requests import checked
from .errors import (
    MalformedReplyError,
    NotResetError,
    ProtocolMismatchError,
    Refusal,
    error_for,
)

A = TypeVar("A", bound=Envelope)

MAX_MESSAGE_BYTES = 64 * 1024 * 1024
_STATUS = {code.value: status for code, status in HTTP_STATUS.items()}


@dataclass(frozen=True)
class Question(Generic[A]):
    """A message that goes out, and the answer that it waits for."""

    id: int
    data: bytes
    answer: type[A]
    awaited: str
    patient: bool = False


class Conversation:
    """Numbers messages and follows the session's step and revision."""

    def __init__(self) -> None:
        self._ids = 0
        self._step: int | None = None
        self._revision: int | None = None

    @property
    def step(self) -> int | None:
        """Step of the newest observation; None before reset."""
        return self._step

    def hello(self, *, sdk: str, role: str, token: str | None) -> Question[Welcome]:
        """The first message."""
        message = checked(
            Hello,
            id=self._next_id(),
            protocols=list(SUPPORTED_SUBPROTOCOLS),
            sdk=sdk,
            role=role,
            token=token,
        )
        return self._question(message, Welcome, "welcome (scene loading, first render)", True)

    def reset(self, spec: ResetSpec) -> Question[Obs]:
        """Starts an episode."""
        message = Reset(id=self._next_id(), spec=spec)
        return self._question(message, Obs, "observation 0 after reset", True)

    def action(self, plan: Plan | Mapping[str, Any]) -> Question[Obs]:
        """Answers the newest observation.

        Raises:
            NotResetError: there is none yet.
            ValueError: a plan that is not valid.
        """
        if self._step is None:
            raise NotResetError(
                Refusal(409, ErrorCode.NOT_RESET, "no episode runs", hint="call reset() first")
            )
        message = Action(id=self._next_id(), step=self._step, plan=valid_plan(plan))
        return self._question(message, Obs, f"observation {self._step + 1}")

    def edit(self, operations: Sequence[Operation | Mapping[str, Any]]) -> Question[Edited]:
        """Changes the session's world, on the revision seen last."""
        message = checked(
            Edit, id=self._next_id(), base_rev=self._revision, operations=list(operations)
        )
        return self._question(message, Edited, "confirmation of the edit")

    def render(self, sensors: Sequence[SensorSpec]) -> Question[View]:
        """Asks for images of the current instant."""
        message = checked(Render, id=self._next_id(), sensors=list(sensors))
        return self._question(message, View, "images")

    def bye(self) -> Question[Result]:
        """Ends the session."""
        return self._question(Bye(id=self._next_id()), Result, "result of the session")

    def read(self, data: bytes | str, question: Question[A]) -> A | None:
        """The answer in ``data``; None where it is progress, or late for an older question.

        Raises:
            StatusError: the worker refuses the message.
            ProtocolMismatchError: the worker speaks another version.
            MalformedReplyError: something else than a valid message came.
        """
        message = _server_message(data)
        if isinstance(message, Error):
            if message.id in {0, question.id} or message.fatal:
                raise _refused(message)
            return None
        if isinstance(message, Progress) or 0 < message.id < question.id:
            return None
        if not isinstance(message, question.answer) or message.id != question.id:
            raise MalformedReplyError(
                f"{type(message).__name__.lower()} with id {message.id} came where "
                f"{question.awaited} with id {question.id} was awaited"
            )
        self._note(message)
        return message

    def _note(self, message: Envelope) -> None:
        if isinstance(message, Obs):
            self._step, self._revision = message.step, message.revision
        elif isinstance(message, Edited | View):
            self._revision = message.revision

    def _next_id(self) -> int:
        self._ids += 1
        return self._ids

    @staticmethod
    def _question(
        message: Envelope, answer: type[A], awaited: str, patient: bool = False
    ) -> Question[A]:
        fields = message.model_dump(mode="python", exclude_none=True)
        return Question(message.id, encode(fields), answer, awaited, patient)


def valid_plan(plan: Plan | Mapping[str, Any]) -> Plan:
    """The plan as its model.

    Raises:
        ValueError: one sentence about what is not allowed in it.
    """
    try:
        return PLAN.validate_python(plan)
    except ValidationError as error:
        raise ValueError(f"plan: {describe(error)}") from error


def _server_message(data: bytes | str) -> Any:
    if isinstance(data, str):
        raise MalformedReplyError("the worker sent text where binary messages are spoken")
    try:
        fields = decode(data, max_bytes=MAX_MESSAGE_BYTES)
    except CodecError as error:
        raise MalformedReplyError(f"the worker's message cannot be read: {error}") from error
    version = fields.get("v")
    if isinstance(version, int) and version != PROTOCOL_VERSION:
        raise ProtocolMismatchError(
            f"the worker sends messages of protocol version {version}; this client speaks "
            f"{PROTOCOL_VERSION}",
            hint="install a client and a worker of the same major version",
        )
    try:
        return SERVER_MESSAGE.validate_python(fields)
    except ValidationError as error:
        raise MalformedReplyError(
            f"the worker's message is not valid: {describe(error)}"
        ) from error


def _refused(message: Error) -> Exception:
    return error_for(
        Refusal(
            status=_STATUS.get(message.code, 500),
            code=message.code,
            detail=message.detail,
            hint=message.hint,
            step=message.step,
        )
    )
