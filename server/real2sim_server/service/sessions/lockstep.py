"""Lock step: the clock moves only on the action that answers its observation."""

from __future__ import annotations

from typing import Generic, TypeVar

from real2sim_proto import ErrorCode

from ..http.problems import ServiceError

A = TypeVar("A")


class LockStep(Generic[A]):
    """Which action is due, and the answer to the last one.

    Ask :meth:`cached_answer` before the world moves and call :meth:`advance` once it has moved; an
    action that is refused in between leaves everything as it was. Actions are compared by their
    canonical bytes.

    Attributes:
        step: of the newest observation; None before the first reset.
        over: whether the episode has ended.
    """

    def __init__(self) -> None:
        self.step: int | None = None
        self.over = False
        self._last: tuple[bytes, A] | None = None

    def reset(self, step: int = 0, *, over: bool = False) -> None:
        """An episode begins at step 0, or is returned to at another."""
        self.step, self.over, self._last = step, over, None

    def end(self) -> None:
        """The episode ends without a step; the last answer can still be had again."""
        self.over = True

    def restore_answer(self, content: bytes, answer: A) -> None:
        """Restore the answer to the last step, after a replay."""
        self._last = (content, answer)

    def cached_answer(self, step: int, content: bytes) -> A | None:
        """The answer already given to this action; None when it is the one that is due.

        Args:
            step: of the observation that the action answers.
            content: canonical bytes of what the action asks for.

        Raises:
            ServiceError: NOT_RESET; STEP_CONFLICT for another action where one was taken;
                STALE_STEP for older steps; EPISODE_OVER; BAD_STEP for newer steps.
        """
        if self.step is None:
            raise not_reset()
        if step == self.step - 1 and self._last is not None:
            return _repeated(step, content, *self._last)
        if step < self.step:
            raise ServiceError(
                ErrorCode.STALE_STEP,
                f"an action for step {step}; the session is at step {self.step}",
                hint="answer the newest observation",
            )
        if self.over:
            raise ServiceError(
                ErrorCode.EPISODE_OVER,
                f"the episode ended at step {self.step}",
                hint="reset the session to start another",
            )
        if step > self.step:
            raise ServiceError(
                ErrorCode.BAD_STEP,
                f"an action for step {step}, which nobody has observed yet; the session is at "
                f"step {self.step}",
                hint="put the step of the newest observation into the action",
            )
        return None

    def is_due(self, step: int) -> bool:
        """Whether an action for ``step`` is the one that the clock waits for."""
        return step == self.step and not self.over

    def advance(self, content: bytes, answer: A, *, over: bool) -> None:
        """The due action was taken; ``answer`` is kept until the next one."""
        self._move(1, over=over)
        self._last = (content, answer)

    def skip(self, steps: int, *, over: bool) -> None:
        """The clock was moved by other means; no answer is kept."""
        self._move(steps, over=over)
        self._last = None

    def _move(self, steps: int, *, over: bool) -> None:
        if self.step is None:
            raise not_reset()
        self.step += steps
        self.over = over


def not_reset() -> ServiceError:
    """NOT_RESET."""
    return ServiceError(
        ErrorCode.NOT_RESET,
        "no episode has begun in this session",
        hint="send reset first; by REST: POST /v1/sessions/{id}/reset",
    )


def _repeated(step: int, content: bytes, taken: bytes, answer: A) -> A:
    if content == taken:
        return answer
    raise ServiceError(
        ErrorCode.STEP_CONFLICT,
        f"step {step} has been answered with another action, which has taken effect",
        hint=f"repeat that action to get its observation again, or act on step {step + 1}",
    )
