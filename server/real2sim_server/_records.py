"""A fast ``__init__`` for frozen dataclasses on hot paths."""

from __future__ import annotations

from dataclasses import MISSING, Field, fields
from typing import Any, TypeVar

R = TypeVar("R")


def made_quickly(record: type[R]) -> type[R]:
    """Class decorator above ``@dataclass`` for frozen dataclasses: a faster ``__init__``.

    It stores the members without the check of frozen classes for each of them.

    Raises:
        TypeError: for unsupported features: keyword-only members, members without an ``__init__``
            argument, or a ``__post_init__``.
    """
    members = fields(record)  # type: ignore[arg-type]
    if hasattr(record, "__post_init__") or any(m.kw_only or not m.init for m in members):
        raise TypeError(f"{record.__name__} does more in its __init__ than to store its members")
    parameters = [_parameter(member) for member in members]
    stored = [f"_members[{m.name!r}] = {_value(m)}" for m in members]
    lines = [f"def __init__(self, {', '.join(parameters)}):", "_members = self.__dict__", *stored]
    made: dict[str, Any] = {f"_{m.name}": _default(m) for m in members}
    exec("\n    ".join(lines), made)
    made["__init__"].__qualname__ = f"{record.__qualname__}.__init__"
    made["__init__"].__annotations__ = record.__init__.__annotations__
    record.__init__ = made["__init__"]  # type: ignore[method-assign]
    return record


def _default(member: Field[Any]) -> Any:
    return member.default if member.default_factory is MISSING else member.default_factory


def _parameter(member: Field[Any]) -> str:
    return member.name if _default(member) is MISSING else f"{member.name}=_{member.name}"


def _value(member: Field[Any]) -> str:
    """Stored value; a default factory as the argument means that no value was passed."""
    if member.default_factory is MISSING:
        return member.name
    return f"_{member.name}() if {member.name} is _{member.name} else {member.name}"
