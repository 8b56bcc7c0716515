"""The client's side of the batch socket, without the socket."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from real2sim_proto import SUPPORTED_SUBPROTOCOLS, ErrorCode
from real2sim_proto.drive import Envelope, Error, Progress
from real2sim_proto.drive_batch import (
    BATCH_SERVER_MESSAGE,
    PLANS,
    BatchAction,
    BatchBye,
    BatchHello,
    BatchMember,
    BatchObs,
    BatchReset,
    BatchResult,
    BatchWelcome,
    Plans,
)
from real2sim_proto.episode import ResetSpec

from ._call import checked
from ._models import sent_fields
from ._protocol import PendingRequest, error_of, server_message
from ._replies import describe
from .errors import ErrorDetails, MalformedReplyError, NotResetError
from .version import SDK

A = TypeVar("A", bound=Envelope)

UNKNOWN = -1
"""Step of a world before its first reset."""


class BatchProtocol:
    """Numbers messages and follows the step of each world.

    Attributes:
        steps: [N] int64, of the newest observation; -1 before the first reset.
    """

    def __init__(self, worlds: int) -> None:
        self.steps: NDArray[np.int64] = np.full(worlds, UNKNOWN)
        self._ids = 0

    def hello(self, members: Sequence[BatchMember]) -> PendingRequest[BatchWelcome]:
        """The first message."""
        message = BatchHello(
            id=self._next_id(),
            protocols=list(SUPPORTED_SUBPROTOCOLS),
            sdk=SDK,
            sessions=list(members),
        )
        return _request(message, BatchWelcome, "welcome of the batch", long_timeout=True)

    def reset(
        self,
        spec: ResetSpec,
        worlds: Sequence[int] | None,
        seeds: Sequence[int] | None,
        start_us: Sequence[int] | None,
    ) -> PendingRequest[BatchObs]:
        """Starts episodes."""
        message = checked(
            BatchReset,
            id=self._next_id(),
            spec=spec,
            worlds=None if worlds is None else list(worlds),
            seeds=None if seeds is None else list(seeds),
            start_us=None if start_us is None else list(start_us),
        )
        return _request(message, BatchObs, "observations after reset", long_timeout=True)

    def action(
        self, plans: Plans | Mapping[str, Any], worlds: Sequence[int] | None
    ) -> PendingRequest[BatchObs]:
        """Answers the newest observation of each world.

        Raises:
            NotResetError: there is none yet.
            ValueError: plans that are not valid.
        """
        steps = self.steps if worlds is None else self.steps[list(worlds)]
        if (steps == UNKNOWN).any():
            raise NotResetError(
                ErrorDetails(409, ErrorCode.NOT_RESET, "no episode runs", hint="call reset() first")
            )
        message = checked(
            BatchAction,
            id=self._next_id(),
            steps=steps,
            plans=valid_plans(plans),
            worlds=None if worlds is None else list(worlds),
        )
        return _request(message, BatchObs, "observations")

    def bye(self) -> PendingRequest[BatchResult]:
        """Ends all sessions."""
        message = BatchBye(id=self._next_id())
        return _request(message, BatchResult, "results", long_timeout=True, idempotent=False)

    def read(self, data: bytes | str, request: PendingRequest[A]) -> A | None:
        """The answer in ``data``; None where it is progress, or late for an older request.

        Raises:
            StatusError: the worker refuses the message.
            ProtocolMismatchError: the worker speaks another version.
            MalformedReplyError: something else than a valid message came.
        """
        message = server_message(data, BATCH_SERVER_MESSAGE)
        if isinstance(message, Error):
            if message.id not in {0, request.id} and not message.fatal:
                return None
            raise error_of(message)
        if isinstance(message, Progress) or 0 < message.id < request.id:
            return None
        if not isinstance(message, request.answer) or message.id != request.id:
            raise MalformedReplyError(
                f"{type(message).__name__} with id {message.id} came where {request.awaited} with "
                f"id {request.id} were awaited"
            )
        if isinstance(message, BatchObs):
            self.steps[message.worlds] = message.step
        return message

    def _next_id(self) -> int:
        self._ids += 1
        return self._ids


def valid_plans(plans: Plans | Mapping[str, Any]) -> Plans:
    """The plans as their model.

    Raises:
        ValueError: one sentence about what is not allowed in them.
    """
    try:
        return PLANS.validate_python(plans)
    except ValidationError as error:
        raise ValueError(f"plans: {describe(error)}") from error


def _request(message: Envelope, answer: type[A], awaited: str, **how: Any) -> PendingRequest[A]:
    return PendingRequest(message.id, sent_fields(message), answer, awaited, **how)
