"""The lock-step rule, without a world."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from real2sim_proto import ErrorCode
from real2sim_server.service.http.responses import ServiceError
from real2sim_server.service.sessions.session import LockStep

ACTIONS = st.lists(
    st.tuples(st.integers(min_value=-3, max_value=2), st.sampled_from([b"left", b"right"])),
    max_size=40,
)


def begun(steps: int = 0) -> LockStep[str]:
    lockstep: LockStep[str] = LockStep()
    lockstep.reset()
    for step in range(steps):
        lockstep.advance(b"plan %d" % step, f"obs {step + 1}", over=False)
    return lockstep


def error(lockstep: LockStep[str], step: int, content: bytes = b"x") -> ErrorCode:
    with pytest.raises(ServiceError) as refused:
        lockstep.cached_answer(step, content)
    return refused.value.code


def test_the_due_action_has_no_answer_yet():
    assert begun(3).cached_answer(3, b"anything") is None


def test_a_repeated_action_gets_the_cached_answer():
    assert begun(3).cached_answer(2, b"plan 2") == "obs 3"


def test_a_different_action_for_an_answered_step_conflicts():
    assert error(begun(3), 2, b"other") is ErrorCode.STEP_CONFLICT


def test_only_the_last_answer_is_kept():
    assert error(begun(3), 1, b"plan 1") is ErrorCode.STALE_STEP


def test_an_action_for_a_future_step_is_refused():
    assert error(begun(3), 4) is ErrorCode.BAD_STEP


def test_actions_require_a_reset():
    assert error(LockStep(), 0) is ErrorCode.NOT_RESET


def test_after_the_end_only_the_last_answer_is_available():
    lockstep = begun(2)
    lockstep.advance(b"last", "end", over=True)
    assert lockstep.cached_answer(2, b"last") == "end"
    assert error(lockstep, 3) is ErrorCode.EPISODE_OVER
    assert error(lockstep, 4) is ErrorCode.EPISODE_OVER


def test_a_reset_discards_the_previous_episode():
    lockstep = begun(3)
    lockstep.reset()
    assert lockstep.step == 0
    assert error(lockstep, 2, b"plan 2") is ErrorCode.BAD_STEP
    assert lockstep.cached_answer(0, b"plan 0") is None


def test_skipped_steps_have_no_cached_answer():
    lockstep = begun(3)
    lockstep.skip(4, over=False)
    assert lockstep.step == 7
    assert error(lockstep, 6, b"plan 6") is ErrorCode.STALE_STEP


@given(ACTIONS)
def test_each_accepted_action_advances_the_step_exactly_once(actions):
    lockstep = begun()
    taken: list[bytes] = []
    for offset, content in actions:
        step = len(taken) + offset
        try:
            answer = lockstep.cached_answer(step, content)
        except ServiceError:
            assert step != len(taken)
            assert not taken or (step, content) != (len(taken) - 1, taken[-1])
        else:
            if answer is None:
                assert step == len(taken)
                taken.append(content)
                lockstep.advance(content, f"obs {len(taken)}", over=False)
            else:
                assert (step, taken[-1]) == (len(taken) - 1, content)
                assert answer == f"obs {len(taken)}"
        assert lockstep.step == len(taken)
