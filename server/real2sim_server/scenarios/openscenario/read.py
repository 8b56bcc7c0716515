"""OpenSCENARIO XML files (ASAM, versions 1.0 to 1.3) as storyboards."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from real2sim_proto.base import invalid_reason
from real2sim_proto.storyboard import Storyboard, resolved, story_actions
from real2sim_proto.storyboard_actions import SpeedAction

from .. import ScenarioError
from .elements import (
    CARLA,
    PEDESTRIANS,
    PRIORITIES,
    VEHICLES,
    ConstraintError,
    Notes,
    Part,
    RawElement,
    Scope,
    declared,
    declared_name,
    read_all,
    read_elements,
    scoped,
    top_level,
    unread,
)
from .parts import (
    CONTROLLERS,
    Actions,
    Conditions,
    Fields,
    Positions,
    plain_value,
)

# --- Catalogs ------------------------------------------------------------------------------------

KINDS = {
    "VehicleCatalog": "Vehicle",
    "PedestrianCatalog": "Pedestrian",
    "MiscObjectCatalog": "MiscObject",
    "ControllerCatalog": "Controller",
    "EnvironmentCatalog": "Environment",
    "ManeuverCatalog": "Maneuver",
    "TrajectoryCatalog": "Trajectory",
    "RouteCatalog": "Route",
}
MAX_FILES = 1000


def located(folder: Path, given: str, part: Part) -> Path:
    """The absolute path of a file or folder that an element names, with ``/`` or ``\\``.

    A name of another case is noted and read if it is the only one that fits.
    """
    given = given.replace("\\", "/")
    path = Path("/") if given.startswith("/") else folder
    for name in given.split("/"):
        path = path.resolve().parent if name == ".." else path / name
        if path.exists() or not path.parent.is_dir():
            continue
        alike = [p for p in path.parent.iterdir() if p.name.lower() == name.lower()]
        if len(alike) == 1:
            path = alike[0]
            part.notes.add(f"{given!r} is read as {path}, which differs in case")
    return path.resolve()


class Catalogs:
    """Catalog entries by catalog and name, from the folders named in a scenario.

    Args:
        folder: folder of the scenario. Files outside the named folders are not read.
        leave_out: see :func:`.elements.read_elements`.
    """

    def __init__(self, folder: Path | None, leave_out: frozenset[str]) -> None:
        self._folder, self._leave_out = folder, leave_out
        self._entries: dict[tuple[str, str, str], tuple[RawElement, str]] = {}
        self.used: list[tuple[RawElement, str]] = []
        self._unread: list[str] = []

    def read(self, part: Part) -> None:
        """The files of ``CatalogLocations``. Raises ScenarioError."""
        for location in part.children():
            if location.tag not in KINDS:
                raise location.refused(KINDS)
            path = location.child("Directory").text("path")
            for file in self._files(location, path):
                self._read_file(file, part.notes)

    def entry(self, part: Part, kind: str) -> Part:
        """The entry that a ``CatalogReference`` names, with its parameters assigned."""
        catalog, name = part.text("catalogName"), part.text("entryName")
        found = self._entries.get((kind, catalog, name))
        if found is None:
            # Some files name the catalog's kind or file instead.
            by_name = [v for (k, _, n), v in self._entries.items() if (k, n) == (kind, name)]
            found = by_name[0] if len(by_name) == 1 else None
        if found is None:
            known = sorted(f"{c}/{n}" for k, c, n in self._entries if k == kind)
            there = ", ".join(known) or "none"
            lacking = f" ({'; '.join(self._unread)})" if self._unread else ""
            raise part.error(
                f"no catalog has the {kind} {catalog}/{name}; there are: {there}{lacking}"
            )
        raw, file = found
        self.used.append(found)
        raw.is_read = True
        assigned = part.find("ParameterAssignments")
        given = {
            declared_name(a, "parameterRef"): a.raw.attributes["value"]
            for a in (assigned.children("ParameterAssignment") if assigned is not None else [])
            if a.text("value") is not None
        }
        texts = {name: part.scope.expression(text) for name, text in given.items()}
        values = {name: part.scope.value(text) for name, text in given.items()}
        # Files of the field use parameters of the scenario in catalogs, too; own ones win.
        entry = Part(raw, file, part.scope, part.notes)
        return entry.within(declared(entry, texts, values))

    def _files(self, part: Part, path: str) -> list[Path]:
        if self._folder is None:
            part.ignore(f"the file came without its catalogs {path!r}")
            return []
        folder = located(self._folder, path, part)
        if not folder.is_dir():
            part.ignore(f"there is no catalog folder {folder}")
            self._unread.append(f"{folder} is not a folder")
            return []
        files = sorted(f for f in folder.iterdir() if f.suffix.lower() == ".xosc")
        if len(files) > MAX_FILES:
            raise part.error(f"folder {path!r} holds more than {MAX_FILES} catalogs")
        return files

    def _read_file(self, file: Path, notes: Notes) -> None:
        """The entries of a file; one that cannot be read costs no other catalog."""
        try:
            root = read_elements(file.read_bytes(), file.name, self._leave_out)
        except (OSError, ScenarioError) as error:
            reason = f"{file}: {error.strerror}" if isinstance(error, OSError) else str(error)
            if notes.strict:
                raise ScenarioError(reason) from error
            notes.add(f"a catalog is left out because it cannot be read: {reason}")
            self._unread.append(reason)
            return
        for catalog in (c for c in root.children if c.tag == "Catalog"):
            name = catalog.attributes.get("name", "")
            for raw in catalog.children:
                entry = raw.attributes.get("name", "")
                self._entries.setdefault((raw.tag, name, entry), (raw, file.name))


# --- Distributions -------------------------------------------------------------------------------

MAX_CASES, MAX_SKIPPED = 1_000_000, 1000


def read_distributions(part: Part) -> tuple[list[dict[str, Any]], Fields]:
    """Parameter values of each case of the deterministic distributions, their product; and the
    stochastic distributions by parameter.

    Raises:
        ScenarioError: an unsupported distribution, or more than a million cases.
    """
    deterministic, stochastic = part.find("Deterministic"), part.find("Stochastic")
    if deterministic is not None:
        return _cases(deterministic), {}
    if stochastic is None:
        raise part.error("<ParameterValueDistribution> needs <Deterministic> or <Stochastic>")
    stochastic.optional("numberOfTestRuns")
    stochastic.optional("randomSeed")
    return [], {
        declared_name(d, "parameterName"): _drawn(d)
        for d in stochastic.children("StochasticDistribution")
    }


def _cases(part: Part) -> list[dict[str, Any]]:
    axes: list[list[dict[str, Any]]] = []
    for each in part.children():
        if each.tag == "DeterministicSingleParameterDistribution":
            name = declared_name(each, "parameterName")
            axes.append([{name: value} for value in _values(each)])
        elif each.tag == "DeterministicMultiParameterDistribution":
            sets = each.child("ValueSetDistribution").children("ParameterValueSet")
            axes.append(
                [
                    {
                        declared_name(a, "parameterRef"): plain_value(a.text("value"))
                        for a in s.children("ParameterAssignment")
                    }
                    for s in sets
                ]
            )
        else:
            raise each.refused(("DeterministicSingleParameterDistribution",))
    if math.prod(len(axis) for axis in axes) > MAX_CASES:
        raise part.error(f"its distributions have more than {MAX_CASES} cases")
    return [
        {name: value for values in case for name, value in values.items()}
        for case in itertools.product(*axes)
    ]


def _values(part: Part) -> list[Any]:
    found = part.only({"DistributionSet", "DistributionRange"})
    if found.tag == "DistributionSet":
        return [plain_value(e.text("value")) for e in found.children("Element")]
    step, limits = float(found.number("stepWidth")), found.child("Range")
    low, high = float(limits.number("lowerLimit")), float(limits.number("upperLimit"))
    if not step > 0 or (high - low) / step > MAX_CASES:
        raise found.error(f"a range from {low} to {high} in steps of {step} has too many values")
    return [low + k * step for k in range(math.floor((high - low) / step + 1e-9) + 1)]


def _drawn(part: Part) -> Fields:
    kinds = {
        "UniformDistribution", "NormalDistribution", "LogNormalDistribution",
        "PoissonDistribution", "ProbabilityDistributionSet", "Histogram",
    }  # fmt: skip
    found = part.only(kinds)
    if found.tag == "ProbabilityDistributionSet":
        values = [
            {"value": plain_value(e.text("value")), "weight": e.number("weight")}
            for e in found.children("Element")
        ]
        return {"kind": "choice", "values": values}
    if found.tag == "Histogram":
        bins = [{**_range(b), "weight": b.number("weight")} for b in found.children("Bin")]
        return {"kind": "histogram", "bins": bins}
    limits = _range(found) if found.find("Range") is not None else {}
    if found.tag == "UniformDistribution":
        return {"kind": "uniform", **limits}
    if found.tag == "PoissonDistribution":
        return {"kind": "poisson", "mean": found.number("expectedValue"), **limits}
    return {
        "kind": "normal",
        "mean": found.number("expectedValue"),
        "variance": found.number("variance"),
        "log": found.tag == "LogNormalDistribution",
        **limits,
    }


def _range(part: Part) -> Fields:
    limits = part.child("Range")
    return {"low": limits.number("lowerLimit"), "high": limits.number("upperLimit")}


EGO_NAMES = frozenset({"ego", "hero", "egovehicle", "ego_vehicle", "vut", "sut"})
"""Default names of the ego, in lower case."""


@dataclass(frozen=True, eq=False)
class ScenarioFile:
    """Contents of a file.

    Attributes:
        board: the storyboard.
        road_file: its road network, as an absolute path if known.
        notes: parts of the file without effect, one sentence each.
        cases: parameter values of each case of a deterministic distribution.
    """

    board: Storyboard
    road_file: Path | None = None
    notes: tuple[str, ...] = ()
    cases: tuple[Mapping[str, Any], ...] = ()


@dataclass(frozen=True)
class ReadOptions:
    """Options for reading a file.

    Attributes:
        parameters: values that override the file's.
        leave_out: names of unsupported elements to ignore.
        ego: name of the ego entity; None: the one with an ego's name.
        strict: refuse elements without effect instead of noting them.
    """

    parameters: Mapping[str, Any] = field(default_factory=dict)
    leave_out: frozenset[str] = frozenset()
    ego: str | None = None
    strict: bool = False


def read_openscenario(path: Path, options: ReadOptions | None = None) -> ScenarioFile:
    """The storyboard of a file, with its catalogs.

    A file with a ``ParameterValueDistribution`` gives its scenario with the distribution's first
    case, and all cases.

    Raises:
        ScenarioError: no such file, not a scenario, or unsupported content, with its line.
    """
    options = options or ReadOptions()
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ScenarioError(f"{path}: cannot be read ({error.strerror})") from error
    root = read_elements(data, path.name, options.leave_out)
    whole = Part(root, path.name, Scope({}, {}), Notes(strict=options.strict))
    distribution = whole.find("ParameterValueDistribution")
    if distribution is None:
        return _read(root, path.name, path.parent.resolve(), options)
    _header(whole)
    target = distribution.child("ScenarioFile").text("filepath")
    cases, drawn = read_distributions(distribution)
    _refuse_unread(root, path.name)
    found = _first_allowed(located(path.parent.resolve(), target, distribution), cases, options)
    board = found.board
    if drawn:
        fields = board.model_dump() | {"distributions": drawn}
        board = _validated(fields, path.name)
    return replace(found, board=board, cases=tuple(cases))


def _first_allowed(
    path: Path, cases: Sequence[Mapping[str, Any]], options: ReadOptions
) -> ScenarioFile:
    """The scenario with the first case that the constraints of its parameters allow."""
    for skipped, case in enumerate(cases or [{}]):
        given = replace(options, parameters={**case, **options.parameters})
        try:
            found = read_openscenario(path, given)
        except ConstraintError as error:
            if skipped + 1 >= min(len(cases), MAX_SKIPPED):
                raise
            reason = str(error)
            continue
        if not skipped:
            return found
        note = f"{skipped} cases of the distribution are skipped: {reason}"
        return replace(found, notes=(*found.notes, note))
    raise AssertionError


def read_openscenario_text(
    data: bytes, name: str, options: ReadOptions | None = None
) -> ScenarioFile:
    """The storyboard of a file's content, without a folder or catalogs. Raises ScenarioError."""
    options = options or ReadOptions()
    return _read(read_elements(data, name, options.leave_out), name, None, options)


def _read(root: RawElement, file: str, folder: Path | None, options: ReadOptions) -> ScenarioFile:
    if root.tag != "OpenSCENARIO":
        raise ScenarioError(f"{file}: its root is <{root.tag}>, expected <OpenSCENARIO>")
    whole = Part(root, file, Scope({}, {}), Notes(strict=options.strict))
    header = _header(whole)
    declarations = whole.find("ParameterDeclarations")
    try:
        scope, parameters = top_level(declarations, options.parameters)
    except ScenarioError:
        raise
    except ValueError as error:
        raise ScenarioError(str(error)) from error
    reader = _Reader(whole.within(scope), folder, options)
    fields = header | {"parameters": parameters} | reader.fields()
    _refuse_unread(root, file)
    for raw, name in reader.catalogs.used:
        _refuse_unread(raw, name)
    board = _validated(fields, file)
    notes = (*whole.notes.sentences(), *_beyond_performance(board))
    return ScenarioFile(board, reader.road_file, notes)


def _beyond_performance(board: Storyboard) -> Iterator[str]:
    """Notes on entities whose actions ask for more than their performance allows."""
    try:
        board = resolved(board)
    except ValueError:
        return  # a value that only an episode has
    init = (([entry.entity], entry.action) for entry in board.init)
    speeds, rates = dict[str, float](), dict[str, float]()
    for names, action in itertools.chain(init, story_actions(board)):
        if not isinstance(action, SpeedAction):
            continue
        dynamics = action.dynamics
        for name in names:
            if action.relative_to is None:
                speeds[name] = max(speeds.get(name, 0.0), abs(float(action.speed)))
            if dynamics.dimension == "rate" and dynamics.shape != "step":
                rates[name] = max(rates.get(name, 0.0), abs(float(dynamics.value)))
    for entity in board.entities:
        name, fastest = entity.name, float(entity.max_speed)
        if speeds.get(name, 0.0) > fastest:
            yield (
                f"{name!r} keeps its maxSpeed of {fastest:g} m/s, although actions ask for up to "
                f"{speeds[name]:g} m/s"
            )
        most = max(float(entity.max_acceleration), float(entity.max_deceleration))
        if rates.get(name, 0.0) > most:
            yield (
                f"{name!r} keeps its maxAcceleration and maxDeceleration of at most {most:g} "
                f"m/s^2, although actions ask for up to {rates[name]:g} m/s^2"
            )


def _refuse_unread(root: RawElement, file: str) -> None:
    for error in unread(root, file):
        raise error


def _validated(fields: Fields, file: str) -> Storyboard:
    try:
        return Storyboard.model_validate(fields)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise ScenarioError(f"{file}: {where or 'storyboard'}: {invalid_reason(first)}") from error


def _header(whole: Part) -> Fields:
    header = whole.child("FileHeader")
    major, minor = header.integer("revMajor"), header.integer("revMinor")
    if major != 1 or not 0 <= minor <= 4:
        raise header.error(f"is of version {major}.{minor}; versions 1.0 to 1.3 are read")
    date = header.text("date", "")
    return {
        "name": header.text("description", "").removeprefix(CARLA)[:200],
        "author": header.text("author", "")[:200],
        "date": date[:40],
    }  # fmt: skip


class _Reader:
    """Reads a scenario with known parameters."""

    def __init__(self, whole: Part, folder: Path | None, options: ReadOptions) -> None:
        self._whole, self._folder, self._options = whole, folder, options
        self.catalogs = Catalogs(folder, options.leave_out)
        header = whole.child("FileHeader")
        default = "relative" if header.integer("revMinor") >= 3 else "absolute"
        mirrored = header.text("description", "").startswith(CARLA)
        self._positions = Positions(self.catalogs.entry, default, mirrored=mirrored)
        self._actions, self._conditions = Actions(self._positions), Conditions(self._positions)
        self._notes, self.road_file = whole.notes, None
        if mirrored:
            self._notes.add("coordinates are left-handed, as CARLA's: they are mirrored")

    road_file: Path | None

    def fields(self) -> Fields:
        """Fields of the storyboard, except its header and parameters."""
        whole = self._whole
        if (locations := whole.find("CatalogLocations")) is not None:
            self.catalogs.read(locations)
        entities = self._entities(whole.child("Entities"))
        road = self._road_network(whole.find("RoadNetwork"))
        board = whole.child("Storyboard")
        init, global_init = self._init(board.child("Init"))
        stop = self._conditions.trigger(board.find("StopTrigger"))
        # The element is required; without a condition it has no effect.
        stop = stop if stop is not None and stop["groups"] else None
        stories = [self._story(s) for s in board.children("Story")]
        return {
            **road,
            "variables": self._variables(whole.find("VariableDeclarations")),
            "entities": entities,
            "init": init,
            "global_init": global_init,
            "stories": stories,
            "stop": stop,
            "ends_episode": stop is not None,
        }

    def _variables(self, part: Part | None) -> Fields:
        found = {}
        for each in part.children("VariableDeclaration") if part is not None else []:
            kind = each.text("variableType")
            value = each.text("value")
            found[each.label()] = value if kind == "string" else plain_value(value)
        return found

    # --- roads and signals ----------------------------------------------------------------------

    def _road_network(self, part: Part | None) -> Fields:
        if part is None:
            return {}
        fields: Fields = {}
        logic, picture = part.find("LogicFile"), part.find("SceneGraphFile")
        if picture is not None:
            picture.ignore("the file's 3D model of the road is not shown")
        if logic is not None:
            name = logic.text("filepath")
            if name:
                fields["roads"] = {"kind": "map", "file": name.replace("\\", "/")}
                if self._folder is not None:
                    self.road_file = located(self._folder, name, logic)
        signals = part.find("TrafficSignals")
        if signals is None:
            return fields
        controllers = [self._controller(c) for c in signals.children("TrafficSignalController")]
        names = sorted({s for c in controllers for p in c["phases"] for s in p["states"]})
        return {
            **fields,
            "controllers": controllers,
            "signals": [{"signal_id": name} for name in names],
        }

    def _controller(self, part: Part) -> Fields:
        phases = []
        for phase in part.children("Phase"):
            states = {
                s.text("trafficSignalId"): s.text("state")
                for s in phase.children("TrafficSignalState")
            }
            phases.append(
                {
                    "name": phase.label(), "duration": phase.magnitude("duration"),
                    "states": states,
                }
            )  # fmt: skip
        return {
            "name": part.label(), "delay": part.number("delay", 0.0),
            "reference": part.optional("reference"), "phases": phases,
        }  # fmt: skip

    # --- entities -------------------------------------------------------------------------------

    def _entities(self, part: Part) -> list[Fields]:
        objects = part.children("ScenarioObject")
        names = [o.label() for o in objects]
        ego = self._ego_of(names, part)
        return [self._entity(o, name, ego) for o, name in zip(objects, names, strict=True)]

    def _ego_of(self, names: list[str], part: Part) -> str | None:
        wanted = self._options.ego
        if wanted is not None and wanted not in names:
            raise part.error(f"no entity is called {wanted!r}; there are: {', '.join(names)}")
        called = [n for n in names if n.lower() in EGO_NAMES]
        found = wanted or (called[0] if called else None)
        if found is None:
            self._notes.add("no entity is the ego; the planner drives as it was recorded")
        return found

    def _entity(self, part: Part, name: str, ego: str | None) -> Fields:
        kinds = ("Vehicle", "Pedestrian", "MiscObject", "CatalogReference")
        holders = part.children(*kinds)
        if len(holders) != 1:
            raise part.error(f"<ScenarioObject> needs one of {', '.join(kinds)}")
        model = holders[0]
        model = self._of_catalog(model) if model.tag == "CatalogReference" else scoped(model)
        self._object_controllers(part, name, ego)
        size, centre = self._box(model)
        fields: Fields = {
            "name": name,
            "kind": "ego" if name == ego else "new",
            "model": model.label("name", ""),
            "box": {"size": size, "centre": centre},
        }
        model.optional("model3d")
        if model.tag == "Vehicle":
            return fields | self._vehicle(model)
        fields["mass"] = model.number_or_none("mass")
        if model.tag == "Pedestrian":
            model.optional("model")
            model.optional("role")
            category = model.choice("pedestrianCategory", PEDESTRIANS)
            return fields | {"category": category}
        return fields | {"category": model.text("miscObjectCategory")}

    def _box(self, part: Part) -> tuple[list[Any], list[Any]]:
        box = part.child("BoundingBox")
        centre, size = box.child("Center"), box.child("Dimensions")
        return (
            [size.number("length"), size.number("width"), size.number("height")],
            [centre.number("x"), self._positions.left(centre, "y"), centre.number("z")],
        )

    def _of_catalog(self, part: Part) -> Part:
        errors = []
        for kind in ("Vehicle", "Pedestrian", "MiscObject"):
            try:
                return self.catalogs.entry(part, kind)
            except ScenarioError as error:
                errors.append(error)
        raise errors[0]

    def _object_controllers(self, part: Part, name: str, ego: str | None) -> None:
        for each in part.children("ObjectController"):
            if name == ego:
                read_all(each.raw)
                self._notes.add(f"the controller of {name!r} is the planner")
            else:
                each.ignore(CONTROLLERS)

    def _vehicle(self, part: Part) -> Fields:
        performance = part.child("Performance")
        part.optional("role")
        if (axles := part.find("Axles")) is not None:
            read_all(axles.raw)
        for trailer in part.children("TrailerHitch", "TrailerCoupler", "Trailer"):
            trailer.ignore("trailers are not simulated")
        for name in ("maxAccelerationRate", "maxDecelerationRate"):
            performance.optional(name)
        return {
            "category": part.choice("vehicleCategory", VEHICLES),
            "mass": part.number_or_none("mass"),
            "max_speed": performance.number("maxSpeed"),
            "max_acceleration": performance.number("maxAcceleration", 10.0),
            "max_deceleration": performance.number("maxDeceleration", 10.0),
        }

    # --- storyboard -----------------------------------------------------------------------------

    def _init(self, part: Part) -> tuple[list[Fields], list[Fields]]:
        actions = part.child("Actions")
        global_init = list[Fields]()
        for action in actions.children("GlobalAction"):
            global_init += _with_effect(self._actions.action(action))
        init = list[Fields]()
        for custom in actions.children("UserDefinedAction"):
            custom.ignore("it is for another program")
        for private in actions.children("Private"):
            entity = private.text("entityRef")
            for action in private.children("PrivateAction"):
                found = _with_effect(self._actions.action(action))
                init += [{"entity": entity, "action": a} for a in found]
        return init, global_init

    def _story(self, part: Part) -> Fields:
        part = scoped(part)
        return {
            "name": part.label(default="story"),
            "acts": [self._act(a) for a in part.children("Act")],
        }

    def _act(self, part: Part) -> Fields:
        return {
            "name": part.label(default="act"),
            "groups": [self._group(g) for g in part.children("ManeuverGroup")],
            "start": self._start(part),
            "stop": self._conditions.trigger(part.find("StopTrigger")),
        }

    def _start(self, part: Part) -> Fields | None:
        """Start of an act or event; None: together with its parent."""
        start = self._conditions.trigger(part.find("StartTrigger"))
        if start is None or start["groups"]:
            return start
        self._notes.add(
            "an act or event with a start trigger without conditions starts at once",
            part.file,
            part.raw.line,
        )
        return None

    def _group(self, part: Part) -> Fields:
        who = part.child("Actors")
        if who.flag("selectTriggeringEntities", False):
            raise who.error("selectTriggeringEntities must be false")
        maneuvers = list[Fields]()
        for each in part.children("Maneuver", "CatalogReference"):
            is_named = each.tag == "CatalogReference"
            found = self.catalogs.entry(each, "Maneuver") if is_named else scoped(each)
            maneuvers.append(self._maneuver(found))
        return {
            "name": part.label(default="group"),
            "entities": [e.text("entityRef") for e in who.children("EntityRef")],
            "times": part.integer("maximumExecutionCount", 1),
            "maneuvers": maneuvers,
        }

    def _maneuver(self, part: Part) -> Fields:
        return {
            "name": part.label(default="maneuver"),
            "events": [self._event(e) for e in part.children("Event")],
        }

    def _event(self, part: Part) -> Fields:
        actions = list[Fields]()
        for each in part.children("Action"):
            name = each.label(default="action")
            # An ignored action keeps its place, because other elements may wait for its end.
            actions += [{"name": name, "action": a} for a in self._actions.action(each)]
        return {
            "name": part.label(default="event"),
            "priority": part.choice("priority", PRIORITIES, "override"),
            "times": part.integer("maximumExecutionCount", 1),
            "actions": actions,
            "start": self._start(part),
        }


def _with_effect(actions: list[Fields]) -> list[Fields]:
    return [action for action in actions if action["kind"] != "custom"]
