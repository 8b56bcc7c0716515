"""What is worked out once for an object."""

from __future__ import annotations

from real2sim_proto.episode import EgoSpec
from real2sim_server.world.common import MAX_CACHED, cache_by_identity


def test_an_object_is_asked_about_once_and_another_of_its_own() -> None:
    asked: list[float] = []

    @cache_by_identity
    def wheelbase(spec: EgoSpec) -> float:
        asked.append(spec.wheelbase)
        return spec.wheelbase

    short, long = EgoSpec(wheelbase=2.5), EgoSpec(wheelbase=3.5)
    assert [wheelbase(s) for s in (short, long, short)] == [2.5, 3.5, 2.5]
    assert asked == [2.5, 3.5]


def test_objects_that_are_gone_are_nobody_elses() -> None:
    @cache_by_identity
    def first(values: list[int]) -> int:
        return values[0]

    assert [first([k]) for k in range(MAX_CACHED + 100)] == list(range(MAX_CACHED + 100))
