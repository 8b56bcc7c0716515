from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from real2sim._calls import RetryPolicy, parse_retry_after


def test_delays_double_up_to_the_maximum():
    policy = RetryPolicy(retries=8)
    delays = [policy.delay(n, jitter=lambda: 0.0) for n in range(8)]
    assert delays == [0.5, 1.0, 2.0, 4.0, 8.0, 8.0, 8.0, 8.0]


@given(st.integers(0, 5), st.floats(0, 1, exclude_max=True))
def test_jitter_shortens_a_delay_by_at_most_a_quarter(attempt, draw):
    policy = RetryPolicy(retries=6)
    full = policy.delay(attempt, jitter=lambda: 0.0)
    assert 0.75 * full <= policy.delay(attempt, jitter=lambda: draw) <= full


def test_after_the_last_retry_there_is_no_delay():
    assert RetryPolicy(retries=2).delay(2) is None


def test_retry_after_overrides_the_delay():
    assert RetryPolicy().delay(0, retry_after=7.0) == 7.0


def test_a_retry_after_over_the_limit_is_not_awaited():
    assert RetryPolicy().delay(0, retry_after=121.0) is None


def test_negative_retries_are_refused():
    with pytest.raises(ValueError, match="retries is -1"):
        RetryPolicy(retries=-1)


@pytest.mark.parametrize(
    ("header", "seconds"),
    [
        (None, None),
        ("3", 3.0),
        ("0.5", 0.5),
        ("-4", 0.0),
        ("nan", None),
        ("soon", None),
        ("Thu, 01 Jan 1970 00:01:40 GMT", 90.0),
        ("Thu, 01 Jan 1970 00:00:00 GMT", 0.0),
    ],
)
def test_retry_after_is_seconds_or_a_date(header, seconds):
    assert parse_retry_after(header, now=10.0) == seconds
