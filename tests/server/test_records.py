"""Records that are made quickly are the dataclasses that they are."""

from __future__ import annotations

import copy
import pickle
from dataclasses import FrozenInstanceError, dataclass, field, replace

import pytest

from real2sim_server._records import made_quickly


@made_quickly
@dataclass(frozen=True, eq=False)
class Record:
    first: int
    second: str = "two"
    third: list[int] = field(default_factory=list)


def test_members_have_their_values_and_defaults():
    assert vars(Record(1)) == {"first": 1, "second": "two", "third": []}
    assert vars(Record(1, third=[3], second="2")) == {"first": 1, "second": "2", "third": [3]}


def test_each_record_has_a_default_of_its_own():
    assert Record(1).third is not Record(1).third


@pytest.mark.parametrize("arguments", [(), (1, "2", [3], 4)])
def test_arguments_that_it_has_not_are_refused(arguments):
    with pytest.raises(TypeError, match="__init__"):
        Record(*arguments)


def test_it_stays_frozen_and_can_be_replaced_copied_and_pickled():
    record = Record(1, "2", [3])
    with pytest.raises(FrozenInstanceError):
        record.first = 2
    assert vars(replace(record, first=2)) == {"first": 2, "second": "2", "third": [3]}
    for same in (copy.deepcopy(record), pickle.loads(pickle.dumps(record))):
        assert vars(same) == vars(record)


def test_a_record_that_checks_what_it_gets_is_refused():
    with pytest.raises(TypeError, match="does more"):

        @made_quickly
        @dataclass(frozen=True)
        class Checked:
            member: int

            def __post_init__(self) -> None:
                raise AssertionError


def test_a_member_may_have_any_name():
    @made_quickly
    @dataclass(frozen=True)
    class Named:
        members: int
        record: int = 2

    assert vars(Named(1)) == {"members": 1, "record": 2}
