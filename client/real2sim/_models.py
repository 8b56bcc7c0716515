"""Models as they travel between a client and a worker of other versions.

What goes out is only what the caller has set: a member that an older worker does not know is not
sent unless somebody asks for it, and a newer worker's defaults are its own. What comes in may hold
members that are not known here, also within models that a worker is strict about.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Mapping
from typing import Any, Literal, TypeVar, get_args, get_origin

from pydantic import BaseModel, TypeAdapter, ValidationError

M = TypeVar("M", bound=BaseModel)
T = TypeVar("T")

_UNKNOWN_VALUES = frozenset({"literal_error", "union_tag_invalid"})
"""Kinds of errors of values that a newer worker may have more of."""


def sent_fields(model: BaseModel) -> dict[str, Any]:
    """What of a model is sent: what was set, and constants as ``type`` and ``kind``.

    None is left out where it is the default, and kept where it says something else.
    """
    fields, known = {}, type(model).model_fields
    constants, given = _constants(type(model)), model.model_fields_set
    for name, value in vars(model).items():
        if name in constants or (name in given and (value is not None or _says(known[name]))):
            fields[name] = _sent(value)
    return fields


def read_fields(messages: TypeAdapter[T], fields: Mapping[str, Any]) -> T:
    """A worker's message; members that are not known here are ignored. Raises ValidationError."""
    return messages.validate_python(fields, extra="ignore")


def read_json(model: type[M], content: bytes) -> M:
    """A worker's answer; members that are not known here are ignored.

    A value that is none of those known here is left out: a list lacks it, a member has its default.

    Raises:
        ValidationError: it is no such model.
    """
    try:
        return model.model_validate_json(content, extra="ignore")
    except ValidationError as error:
        problems = error.errors(include_url=False, include_context=False, include_input=False)
        if any(problem["type"] not in _UNKNOWN_VALUES for problem in problems):
            raise
        fields = json.loads(content)
        # From the end of lists on, so that places before stay what they are.
        for problem in reversed(problems):
            _leave_out(fields, problem["loc"])
        return model.model_validate(fields, extra="ignore")


def _sent(value: Any) -> Any:
    if isinstance(value, BaseModel):
        return sent_fields(value)
    if isinstance(value, list | tuple) and value and isinstance(value[0], BaseModel):
        return [sent_fields(item) for item in value]
    if isinstance(value, dict):
        return {key: _sent(item) for key, item in value.items()}
    return value


def _says(field: Any) -> bool:
    """Whether None is something else than the default of a member."""
    return field.is_required() or field.get_default(call_default_factory=True) is not None


@functools.cache
def _constants(model: type[BaseModel]) -> frozenset[str]:
    """Members that have one value only."""
    return frozenset(
        name
        for name, field in model.model_fields.items()
        if get_origin(field.annotation) is Literal and len(get_args(field.annotation)) == 1
    )


def _leave_out(fields: Any, place: tuple[int | str, ...]) -> None:
    """Take out the innermost item or member that an error's place names.

    Places hold names of members of unions besides, which the value does not have.
    """
    holder, key, inside = None, None, fields
    for part in place:
        known = isinstance(inside, dict) and part in inside
        if known or (isinstance(inside, list) and isinstance(part, int) and part < len(inside)):
            holder, key, inside = inside, part, inside[part]
    if holder is not None:
        del holder[key]
