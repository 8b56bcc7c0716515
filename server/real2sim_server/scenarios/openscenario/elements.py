"""Elements of an OpenSCENARIO file with their lines, and a record of the parts that were read.

Every element and attribute must be read, or ignored with a note. The others are unsupported, and
are refused by name and line.
"""

from __future__ import annotations

import re
import xml.parsers.expat
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from real2sim_proto.storyboard_values import evaluated

from ..._files import xml_data
from .. import ScenarioError

MAX_BYTES, MAX_ELEMENTS, MAX_DEPTH = 64 << 20, 1_000_000, 200

WITHOUT_EFFECT = frozenset({"License", "Properties"})
"""Elements with notes of other programs, which are not part of the scenario."""

CARLA = "CARLA:"
"""Beginning of the description of files with CARLA's left-handed coordinates."""

_NEEDED = {
    "Event": {"Action"},
    "Maneuver": {"Event"},
    "ManeuverGroup": {"Maneuver", "CatalogReference"},
    "Act": {"ManeuverGroup"},
    "Story": {"Act"},
}
PRUNED = frozenset(
    {
        "GlobalAction", "PrivateAction", "AppearanceAction", "Action", "ControllerAction",
        "Private", "InfrastructureAction", *_NEEDED,
    }
)  # fmt: skip
"""Elements that are dropped together with the last of their omitted children."""


@dataclass(eq=False)
class RawElement:
    """An element as in the file."""

    tag: str
    line: int
    attributes: Mapping[str, str]
    children: list[RawElement] = field(default_factory=list)
    read: set[str] = field(default_factory=set)
    is_read: bool = False


class Scope:
    """Parameters by name, and their replacements in expressions.

    Args:
        texts: by name, ``$name`` of a remaining parameter, plain text, or ``(expression)``.
        values: their current values.
    """

    def __init__(self, texts: Mapping[str, str], values: Mapping[str, Any]) -> None:
        self.texts, self.values = dict(texts), dict(values)

    def expression(self, text: str) -> str:
        """A text with the parameters of this scope replaced."""
        if not text.startswith("$"):
            return text
        if not text.startswith("${"):
            found = self._text(text[1:])
            return f"${{{found}}}" if found.startswith("(") else found
        return _NAME.sub(lambda m: _atom(self._text(m.group(1))), text)

    def value(self, text: str) -> Any:
        """The current value of a text or expression."""
        return evaluated(text, self.values)

    def _text(self, name: str) -> str:
        if name not in self.texts:
            known = ", ".join(sorted(self.texts)) or "none"
            raise ValueError(f"'${name}' names no parameter; there are: {known}")
        return self.texts[name]


_NAME = re.compile(r"\$([A-Za-z_]\w*)")


def _atom(text: str) -> str:
    return text if text.startswith(("$", "(")) else f"({text})"


class ConstraintError(ScenarioError):
    """A value of a parameter that the constraints of its declaration do not allow."""


class Notes:
    """Parts of a scenario that are ignored, because they have no effect on the drive.

    Args:
        strict: refuse such parts instead.
    """

    def __init__(self, *, strict: bool = False) -> None:
        self.strict = strict
        self._lines: dict[str, dict[tuple[str, int], None]] = {}

    def add(self, sentence: str, file: str = "", line: int = 0) -> None:
        """Note a part of a file, at most once for each line."""
        self._lines.setdefault(sentence, {})[file, line] = None

    def sentences(self) -> tuple[str, ...]:
        """One sentence for each kind, with its count and its first lines."""
        return tuple(s + self._where(list(lines)) for s, lines in self._lines.items())

    @staticmethod
    def _where(lines: list[tuple[str, int]]) -> str:
        if not lines[0][1]:
            return ""
        several = len({file for file, _ in lines}) > 1
        shown = [f"{file} {line}" if several else str(line) for file, line in lines[:5]]
        more = ", ..." if len(lines) > len(shown) else ""
        count = f"{len(lines)} times, " if len(lines) > 1 else ""
        return f" ({count}line {', '.join(shown)}{more})"


@dataclass(eq=False)
class Part:
    """An element that is being read, in a file and a scope."""

    raw: RawElement
    file: str
    scope: Scope
    notes: Notes

    @property
    def tag(self) -> str:
        """Its name."""
        return self.raw.tag

    def error(self, message: str) -> ScenarioError:
        """An error that names file and line."""
        return ScenarioError(f"{self.file}, line {self.raw.line}: {message}")

    def within(self, scope: Scope) -> Part:
        """The same element in another scope."""
        return Part(self.raw, self.file, scope, self.notes)

    def ignore(self, reason: str) -> None:
        """Ignore the element and note why. Raises ScenarioError if notes are strict."""
        if self.notes.strict:
            raise self.error(f"<{self.tag}> is not supported: {reason}")
        read_all(self.raw)
        self.notes.add(f"<{self.tag}> is ignored: {reason}", self.file, self.raw.line)

    def ignore_attribute(self, name: str, reason: str) -> None:
        """Ignore an attribute of the element and note why. Raises ScenarioError if strict."""
        if self.notes.strict:
            raise self.error(f"{name} of <{self.tag}> is not supported: {reason}")
        self.raw.read.add(name)
        self.notes.add(f"{name} of <{self.tag}> is ignored: {reason}", self.file, self.raw.line)

    # --- attributes -----------------------------------------------------------------------------

    def text(self, name: str, default: str | None = None) -> str:
        """The current value of an attribute."""
        given = self.given(name, default)
        value = self._evaluated(name, given)
        if isinstance(value, bool):
            return "true" if value else "false"
        return f"{value:.17g}" if isinstance(value, float) else str(value)

    def label(self, name: str = "name", default: str | None = None) -> str:
        """A name: the text as it is, or the value of the parameter that it consists of."""
        given = self.given(name, default)
        if given.startswith("$"):
            # Text that begins with $ would be an expression in the storyboard.
            given = str(self.scope.values.get(given[1:], given)).lstrip("$")
        return given or (default or "")

    def optional(self, name: str) -> str | None:
        """The current value of an attribute; None if it is missing."""
        return self.text(name) if name in self.raw.attributes else None

    def number(self, name: str, default: float | None = None) -> float | str:
        """A number, or an expression of parameters."""
        given = self.given(name, None if default is None else repr(default))
        value = self._evaluated(name, given)
        try:
            number = float(value)
        except (TypeError, ValueError):
            raise self.error(f"{name} of <{self.tag}> is {given!r}; it must be a number") from None
        text = self.scope.expression(given)
        return text if text.startswith("$") and _NAME.search(text) else number

    def number_or_none(self, name: str) -> float | str | None:
        """A number, or None if it is absent."""
        return self.number(name) if name in self.raw.attributes else None

    def magnitude(self, name: str, default: float | None = None) -> float | str:
        """A non-negative time or distance, or an expression of parameters."""
        found = self.number(name, default)
        value = float(self._evaluated(name, self.given(name, repr(default))))
        if value < 0:
            raise self.error(f"{name} of <{self.tag}> is {value:g}; it must be 0 or more")
        return found

    def magnitude_or_none(self, name: str) -> float | str | None:
        """A time or distance, or None if it is absent."""
        return self.magnitude(name) if name in self.raw.attributes else None

    def integer(self, name: str, default: int | None = None) -> int:
        """The current value of an integer attribute."""
        value = self._evaluated(name, self.given(name, None if default is None else str(default)))
        try:
            number = float(value)
        except (TypeError, ValueError):
            number = 0.5
        if not number.is_integer():
            raise self.error(f"{name} of <{self.tag}> is {value!r}; it must be a whole number")
        return int(number)

    def flag(self, name: str, default: bool | None = None) -> bool:
        """The current value of a boolean attribute."""
        given = self.given(name, None if default is None else str(default).lower())
        value = str(self._evaluated(name, given)).lower()
        if value not in {"true", "false", "1", "0"}:
            raise self.error(f"{name} of <{self.tag}> is {value!r}; allowed: true, false")
        return value in {"true", "1"}

    def choice(self, name: str, allowed: Mapping[str, Any], default: str | None = None) -> Any:
        """The value of ``allowed`` for an attribute."""
        given = self.text(name, default)
        if given not in allowed:
            raise self.error(
                f"{name} of <{self.tag}> is {given!r}, which is not supported; allowed: "
                f"{', '.join(allowed)}"
            )
        return allowed[given]

    def given(self, name: str, default: str | None = None) -> str:
        """An attribute as in the file."""
        self.raw.read.add(name)
        given = self.raw.attributes.get(name, default)
        if given is None:
            raise self.error(f"<{self.tag}> lacks its attribute {name}")
        return given.strip()

    def _evaluated(self, name: str, given: str) -> Any:
        try:
            return self.scope.value(given)
        except ValueError as error:
            raise self.error(f"{name} of <{self.tag}>: {error}") from error

    # --- children -------------------------------------------------------------------------------

    def children(self, *tags: str) -> list[Part]:
        """Children with these names in order; all without names."""
        found = [c for c in self.raw.children if not tags or c.tag in tags]
        return [self._of(c) for c in found]

    def find(self, tag: str) -> Part | None:
        """The child with a name, or None."""
        found = self.children(tag)
        if len(found) > 1:
            raise self.error(f"<{self.tag}> has {len(found)} elements <{tag}>; one is allowed")
        return found[0] if found else None

    def child(self, tag: str) -> Part:
        """The child with a name; required."""
        found = self.find(tag)
        if found is None:
            raise self.error(f"<{self.tag}> lacks <{tag}>")
        return found

    def only(self, tags: Any = None) -> Part:
        """The single child of a choice element, with one of these names."""
        here = [c for c in self.raw.children if c.tag not in WITHOUT_EFFECT]
        if len(here) != 1:
            raise self.error(f"<{self.tag}> has {len(here)} elements; it needs one")
        if tags is not None and here[0].tag not in tags:
            raise self._of(here[0]).refused(tags)
        return self._of(here[0])

    def refused(self, supported: Any = ()) -> ScenarioError:
        """The error of an element that is not supported."""
        hint = f"; supported here: {', '.join(sorted(supported))}" if supported else ""
        return self.error(
            f"<{self.tag}> is not supported{hint}. Leave it out of the file, or name it in "
            "`leave_out`"
        )

    def _of(self, raw: RawElement) -> Part:
        raw.is_read = True
        return Part(raw, self.file, self.scope, self.notes)


def read_all(raw: RawElement) -> None:
    """Mark an element and everything in it as read."""
    raw.is_read = True
    raw.read.update(raw.attributes)
    for child in raw.children:
        read_all(child)


def unread(raw: RawElement, file: str) -> Iterator[ScenarioError]:
    """Errors for unread parts, in file order."""
    for name in raw.attributes:
        if name not in raw.read and ":" not in name and name != "xmlns":
            yield ScenarioError(
                f"{file}, line {raw.line}: attribute {name} of <{raw.tag}> is not supported"
            )
    for child in raw.children:
        if child.tag in WITHOUT_EFFECT:
            continue
        if not child.is_read:
            yield Part(child, file, Scope({}, {}), Notes()).refused()
        else:
            yield from unread(child, file)


def read_elements(data: bytes, file: str, leave_out: frozenset[str] = frozenset()) -> RawElement:
    """The root of an XML file.

    Args:
        data: content.
        file: name in messages.
        leave_out: names of elements to remove before anything is read.

    The prefix of the root's namespace is removed from all names.

    Raises:
        ScenarioError: too large, too deep, not XML, or with a document type.
    """
    if len(data) > MAX_BYTES:
        raise ScenarioError(f"{file}: is larger than {MAX_BYTES >> 20} MiB, the most that is read")
    builder = _Builder(file)
    try:
        data = xml_data(data)
    except ValueError as error:
        raise ScenarioError(f"{file}: {error}") from error
    except (xml.parsers.expat.ExpatError, LookupError) as error:
        raise ScenarioError(f"{file}: is not an XML file ({error})") from error
    try:
        builder.parser.Parse(data, True)
    except ScenarioError:
        raise
    except (xml.parsers.expat.ExpatError, LookupError, ValueError) as error:
        # The last two exceptions come from encodings that Python does not support.
        raise ScenarioError(f"{file}: is not an XML file ({error})") from error
    if builder.root is None:
        raise ScenarioError(f"{file}: is empty")
    _take_out(builder.root, leave_out)
    builder.root.is_read = True
    return builder.root


def _take_out(raw: RawElement, names: frozenset[str]) -> None:
    kept = []
    for child in raw.children:
        if child.tag in names:
            continue
        had = bool(child.children)
        _take_out(child, names)
        if names and had and child.tag in PRUNED and not _acts(child):
            continue
        kept.append(child)
    raw.children = kept


def _acts(raw: RawElement) -> bool:
    """Whether an element that may be pruned still has content."""
    needed = _NEEDED.get(raw.tag)
    return any(needed is None or c.tag in needed for c in raw.children)


class _Builder:
    def __init__(self, file: str) -> None:
        self._file, self._open, self._count, self._prefix = file, list[RawElement](), 0, ""
        self.root: RawElement | None = None
        self.parser = xml.parsers.expat.ParserCreate()
        self.parser.StartElementHandler = self._start
        self.parser.EndElementHandler = self._end

    def _start(self, tag: str, attributes: dict[str, str]) -> None:
        self._count += 1
        if self._count > MAX_ELEMENTS or len(self._open) >= MAX_DEPTH:
            raise ScenarioError(
                f"{self._file}: more than {MAX_ELEMENTS} elements, or nested deeper than "
                f"{MAX_DEPTH}"
            )
        if not self._open:
            self._prefix = tag[: tag.rfind(":") + 1]
        tag = tag.removeprefix(self._prefix)
        made = RawElement(tag, self.parser.CurrentLineNumber, attributes)
        if self._open:
            self._open[-1].children.append(made)
        else:
            self.root = made
        self._open.append(made)

    def _end(self, _tag: str) -> None:
        self._open.pop()


# --- Names ---------------------------------------------------------------------------------------

RULES = {
    "greaterThan": "greater_than",
    "lessThan": "less_than",
    "equalTo": "equal_to",
    "greaterOrEqual": "greater_or_equal",
    "lessOrEqual": "less_or_equal",
    "notEqualTo": "not_equal_to",
}
EDGES = {
    "none": "none",
    "rising": "rising",
    "falling": "falling",
    "risingOrFalling": "rising_or_falling",
}
SHAPES = {"linear": "linear", "cubic": "cubic", "sinusoidal": "sinusoidal", "step": "step"}
DIMENSIONS = {"time": "time", "distance": "distance", "rate": "rate"}
ELEMENTS = {
    "story": "story",
    "act": "act",
    "maneuverGroup": "maneuver_group",
    "maneuver": "maneuver",
    "event": "event",
    "action": "action",
}
STATES = {
    "standbyState": "standby",
    "runningState": "running",
    "completeState": "complete",
    "startTransition": "start_transition",
    "endTransition": "end_transition",
    "stopTransition": "stop_transition",
    "skipTransition": "skip_transition",
}
MEASURES = {
    "euclidianDistance": "euclidean",
    "cartesianDistance": "euclidean",
    "longitudinal": "longitudinal",
    "lateral": "lateral",
}
FRAMES = {"entity": "entity", "lane": "lane", "road": "road"}
PRIORITIES = {
    "override": "override",
    "overwrite": "override",
    "skip": "skip",
    "parallel": "parallel",
}
PLACES = {
    "any": "any",
    "leadingReferencedEntity": "leading",
    "trailingReferencedEntity": "trailing",
}
SIDES = {"any": "any", "leftToReferencedEntity": "left", "rightToReferencedEntity": "right"}
VEHICLES = {
    "car": "car",
    "van": "van",
    "truck": "truck",
    "semitrailer": "truck",
    "trailer": "truck",
    "bus": "bus",
    "motorbike": "motorcycle",
    "bicycle": "cyclist",
    "train": "bus",
    "tram": "bus",
    "wheelchair": "pedestrian",
    "standupScooter": "cyclist",
    "workMachine": "truck",
}
PEDESTRIANS = {"pedestrian": "pedestrian", "wheelchair": "pedestrian", "animal": "animal"}

LAMPS = {
    "brakeLights": "brake",
    "indicatorLeft": "indicator_left",
    "indicatorRight": "indicator_right",
    "warningLights": "hazard",
}


def back(words: dict[str, str], word: str) -> str:
    """The first OpenSCENARIO word for a word of the storyboard."""
    return next(theirs for theirs, ours in words.items() if ours == word)


# --- Parameters ----------------------------------------------------------------------------------

NUMBERS = frozenset({"double", "integer", "int", "unsignedInt", "unsignedShort"})
KINDS = {name: name for name in (*NUMBERS, "string", "boolean", "dateTime")}


def scoped(part: Part) -> Part:
    """An element in the scope of its parameter declarations; inner names take precedence."""
    return part.within(declared(part, {}, {}))


def declared(part: Part, texts: Mapping[str, str], values: Mapping[str, Any]) -> Scope:
    """The scope of an element below the top level: that around it, and its own declarations. A
    parameter has its assigned value, or its default.
    """
    scope = Scope(part.scope.texts, part.scope.values)
    declarations = part.find("ParameterDeclarations")
    for each in declarations.children("ParameterDeclaration") if declarations is not None else []:
        name, kind = declared_name(each), each.choice("parameterType", KINDS)
        own = each.within(scope)
        own.text("value")
        given = own.raw.attributes["value"].strip()
        text, value = scope.expression(given), scope.value(given)
        if name in texts:
            text, value = texts[name], values[name]
        scope.texts[name] = embedded(text)
        scope.values[name] = typed(each, value, kind)
        check_constraints(own, name, scope.values[name])
    return scope


def top_level(part: Part | None, given: Mapping[str, Any]) -> tuple[Scope, dict[str, Any]]:
    """The scope of a scenario's declarations, and the parameters of the storyboard.

    Parameters with plain values become storyboard parameters; others are expressions of them.

    Args:
        part: ``ParameterDeclarations``.
        given: values that override the file's.

    Raises:
        ScenarioError: a value that violates a constraint, or an undeclared name.
    """
    scope, parameters = Scope({}, {}), dict[str, Any]()
    declarations = part.children("ParameterDeclaration") if part is not None else []
    for each in declarations:
        name, kind = declared_name(each), each.choice("parameterType", KINDS)
        own = each.within(scope)
        text = own.raw.attributes.get("value", "")
        value = typed(each, own.text("value"), kind)
        if name in given:
            text, value = "", typed(each, given[name], kind)
        scope.values[name] = value
        if "$" in text:
            scope.texts[name] = embedded(scope.expression(text))
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


def declared_name(part: Part, attribute: str = "name") -> str:
    """The name of a parameter; some files write it with a leading ``$``."""
    return part.given(attribute).removeprefix("$")


def typed(part: Part, value: Any, kind: str) -> Any:
    """A value converted to its declared type."""
    if kind == "boolean":
        return value if isinstance(value, bool) else str(value).lower() in {"true", "1", "1.0"}
    if kind not in NUMBERS:
        return f"{value:.17g}" if isinstance(value, float) else str(value)
    try:
        return float(value)
    except (TypeError, ValueError):
        raise part.error(f"value {value!r} of a parameter of type {kind} is not a number") from None


def check_constraints(part: Part, name: str, value: Any) -> None:
    """Raises ScenarioError if a parameter satisfies none of its constraint groups."""
    groups = part.children("ConstraintGroup")
    if not groups:
        return
    kept = [
        all(holds(value, c.choice("rule", RULES), c.text("value")) for c in g.children())
        for g in groups
    ]
    if not any(kept):
        message = f"parameter {name!r} is {value!r}, which its constraints do not allow"
        raise ConstraintError(str(part.error(message)))


def holds(value: Any, rule: str, text: str) -> bool:
    """Whether a value meets a rule; numbers are compared as numbers, all else as text."""
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


def embedded(text: str) -> str:
    """An expression as part of another one."""
    return f"({text[2:-1]})" if text.startswith("${") else text
