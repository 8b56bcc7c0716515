"""Values cached by object identity."""

from __future__ import annotations

from real2sim_proto.episode import EgoSpec
from real2sim_server.world.common import MAX_CACHED, cache_by_identity


def test_a_function_is_called_once_per_object() -> None:
    asked: list[float] = []

    @cache_by_identity
    def wheelbase(spec: EgoSpec) -> float:
        asked.append(spec.wheelbase)
        return spec.wheelbase

    short, long = EgoSpec(wheelbase=2.5), EgoSpec(wheelbase=3.5)
    assert [wheelbase(s) for s in (short, long, short)] == [2.5, 3.5, 2.5]
    assert asked == [2.5, 3.5]


def test_new_objects_do_not_get_values_of_deleted_ones() -> None:
    @cache_by_identity
    def first(values: list[int]) -> int:
        return values[0]

    assert [first([k]) for k in range(MAX_CACHED + 100)] == list(range(MAX_CACHED + 100))
