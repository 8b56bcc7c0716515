"""A corner case: a storyboard with parameters, and the list of all."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from real2sim_proto.storyboard import Storyboard

Fields = dict[str, Any]


@dataclass(frozen=True)
class CornerCase:
    """One of the gallery.

    Attributes:
        name: to ask for it by.
        title: what happens, in a sentence.
        family: of what kind it is, such as ``crossing``.
        parameters: their defaults; lengths in m, speeds in m/s, times in s.
        make: the storyboard's fields.
    """

    name: str
    title: str
    family: str
    parameters: Mapping[str, float]
    make: Callable[[], Fields]

    def storyboard(self, **parameters: float) -> Storyboard:
        """The storyboard with other values for some parameters.

        Raises:
            ValueError: a parameter that it does not have.
        """
        if unknown := sorted(set(parameters) - set(self.parameters)):
            raise ValueError(
                f"corner case {self.name!r} has no parameter {unknown[0]!r}; it has: "
                f"{', '.join(self.parameters)}"
            )
        values = {**self.parameters, **{k: float(v) for k, v in parameters.items()}}
        return Storyboard.model_validate(
            {**self.make(), "name": self.title, "author": "Real2Sim", "parameters": values,
             "date": "2026-01-01T00:00:00"}
        )  # fmt: skip


GALLERY: dict[str, CornerCase] = {}
"""By name."""


def corner_case(name: str) -> CornerCase:
    """The case of a name, with or without the prefix ``gallery:``.

    Raises:
        ValueError: there is none.
    """
    found = GALLERY.get(name.removeprefix("gallery:"))
    if found is None:
        raise ValueError(f"the gallery has no {name!r}; it has: {', '.join(GALLERY)}")
    return found


def case(title: str, **parameters: float) -> Callable[[Callable[[], Fields]], Callable[[], Fields]]:
    """Adds what makes a storyboard's fields to the gallery, by the function's name; its module's
    name is the family."""

    def register(make: Callable[[], Fields]) -> Callable[[], Fields]:
        name, family = make.__name__, make.__module__.rpartition(".")[2]
        GALLERY[name] = CornerCase(name, title, family, parameters, make)
        return make

    return register
