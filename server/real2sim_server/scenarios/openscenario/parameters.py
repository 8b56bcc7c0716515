"""Declarations of parameters: those that stay parameters of the storyboard, and those that follow
from others."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from .elements import Part, Scope
from .names import RULES

NUMBERS = frozenset({"double", "integer", "int", "unsignedInt", "unsignedShort"})
KINDS = {name: name for name in (*NUMBERS, "string", "boolean", "dateTime")}


def scoped(part: Part) -> Part:
    """An element in the scope of the parameters that it declares for itself: inner names win."""
    declarations = part.find("ParameterDeclarations")
    return part if declarations is None else part.within(declared(declarations, {}, {}))


def declared(part: Part | None, texts: Mapping[str, str], values: Mapping[str, Any]) -> Scope:
    """The scope of declarations below the top level, in the scope in which they stand: a parameter
    stands for what is assigned to it, or for its default."""
    scope = Scope({}, {}) if part is None else Scope(part.scope.texts, part.scope.values)
    for each in part.children("ParameterDeclaration") if part is not None else []:
        name, kind = each.text("name"), each.choice("parameterType", KINDS)
        own = each.within(scope)
        own.text("value")
        given = own.raw.attributes["value"].strip()
        text, value = scope.expression(given), scope.value(given)
        if name in texts:
            text, value = texts[name], values[name]
        scope.texts[name] = _embedded(text)
        scope.values[name] = typed(each, value, kind)
        check_constraints(own, name, scope.values[name])
    return scope


def top_level(part: Part | None, given: Mapping[str, Any]) -> tuple[Scope, dict[str, Any]]:
    """The scope of a scenario's declarations, and the parameters of the storyboard: those whose
    value is a plain one. Others are expressions of them.

    Args:
        part: ``ParameterDeclarations``.
        given: values instead of those of the file.

    Raises:
        ScenarioError: a value that breaks a constraint, or a name that is not declared.
    """
    scope, parameters = Scope({}, {}), dict[str, Any]()
    declarations = part.children("ParameterDeclaration") if part is not None else []
    for each in declarations:
        name, kind = each.text("name"), each.choice("parameterType", KINDS)
        own = each.within(scope)
        text = own.raw.attributes.get("value", "")
        value = typed(each, own.text("value"), kind)
        if name in given:
            text, value = "", typed(each, given[name], kind)
        scope.values[name] = value
        if "$" in text:
            scope.texts[name] = _embedded(scope.expression(text))
        elif kind in NUMBERS or kind == "boolean":
            parameters[name] = value
            scope.texts[name] = f"${name}"
        else:
            parameters[name] = value
            scope.texts[name] = str(value)
        check_constraints(own, name, value)
    if unknown := sorted(set(given) - set(scope.values)):
        names = ", ".join(scope.values) or "none"
        where = part.file if part is not None else "the scenario"
        raise ValueError(f"{where} has no parameter {unknown[0]!r}; there are: {names}")
    return scope, parameters


def typed(part: Part, value: Any, kind: str) -> Any:
    """A value as its declaration says."""
    if kind == "boolean":
        return value if isinstance(value, bool) else str(value).lower() in {"true", "1", "1.0"}
    if kind not in NUMBERS:
        return f"{value:.17g}" if isinstance(value, float) else str(value)
    try:
        return float(value)
    except (TypeError, ValueError):
        raise part.error(f"value {value!r} of a parameter of type {kind} is no number") from None


def check_constraints(part: Part, name: str, value: Any) -> None:
    """Raises ScenarioError: none of the groups of constraints of a parameter holds."""
    groups = part.children("ConstraintGroup")
    if not groups:
        return
    kept = [
        all(_holds(value, c.choice("rule", RULES), c.text("value")) for c in g.children())
        for g in groups
    ]
    if not any(kept):
        raise part.error(f"parameter {name!r} is {value!r}, which its constraints do not allow")


def _holds(value: Any, rule: str, text: str) -> bool:
    try:
        a: Any = float(value)
        b: Any = float(text)
    except (TypeError, ValueError):
        a, b = str(value), text
    found: bool = {
        "greater_than": a > b, "less_than": a < b, "equal_to": a == b,
        "greater_or_equal": a >= b, "less_or_equal": a <= b, "not_equal_to": a != b,
    }[rule]  # fmt: skip
    return found


def _embedded(text: str) -> str:
    """An expression as a part of others."""
    return f"({text[2:-1]})" if text.startswith("${") else text
