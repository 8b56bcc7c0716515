"""Scenario files as spaces: the storyboard of each point, and parameters of the file's
distributions.
"""

from __future__ import annotations

import json
import math
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from real2sim_proto.storyboard import (
    Choice,
    Distribution,
    MapRoads,
    Normal,
    Storyboard,
    Uniform,
    ValueRange,
    ValueSet,
)

from .._files import atomic_file
from ..console import CommandError
from ..demo.street import unpack_street
from ..scenarios import ScenarioError
from ..scenarios.fit import fitted_to_scene
from ..scenarios.gallery import corner_case
from ..scenarios.openscenario import (
    ReadOptions,
    ScenarioFile,
    read_openscenario,
    read_openscenario_text,
    write_openscenario,
)
from ..scene import Scene
from ..scene.errors import BundleError
from ..scene.io import DEMO_SCENE, load_scene
from .parameters import Value

# --- Scenes --------------------------------------------------------------------------------------


def open_scene(name: str, folder: Path | None = None) -> Scene:
    """The bundle of that path, or of that name below a folder; the demo's street without one.

    Raises:
        CommandError: there is none.
        BundleError: it cannot be read.
    """
    places = [Path(name), *([folder / name] if folder is not None else [])]
    for place in places:
        if place.is_dir():
            return load_scene(place)
    if name == DEMO_SCENE:
        # As a bundle, whose hash recordings name: the demo's worker has it so too.
        with tempfile.TemporaryDirectory(prefix="real2sim-street-") as made:
            unpack_street(Path(made), DEMO_SCENE)
            return load_scene(Path(made) / DEMO_SCENE)
    raise CommandError(
        f"no scene {name!r}; give the path of a bundle, its name below the folder of --scenes, or "
        f"{DEMO_SCENE}"
    )


GALLERY = "gallery:"
SECONDS = 15.0
"""That an episode lasts where the case does not say."""
MOST_BYTES = 16 << 20
MOST_VALUES = 1000
WIDTHS = 4.0
"""Standard deviations at which a normal is cut off that gives no range."""


class ScenarioSource(BaseModel):
    """``storyboard`` in the file of a space: a name, or these fields.

    Attributes:
        file: OpenSCENARIO file (.xosc), storyboard (.json) or ``gallery:NAME``.
        ego: entity that is the ego; None: the one that is called so.
        leave_out: elements that are not supported and are left out.
        as_it_is: the scene's world is the file's, so that nothing is laid along the scene's route.
        alone: nothing beside an OpenSCENARIO file is read: no catalogs, no road network.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    file: str = Field(min_length=1, max_length=4000)
    ego: str | None = None
    leave_out: tuple[str, ...] = ()
    as_it_is: bool = False
    alone: bool = False


@dataclass(frozen=True, eq=False)
class StoryboardSpace:
    """What makes the storyboard of each point of a space.

    The file is read anew for each, so that a parameter is varied wherever it stands: in numbers as
    well as in names, counts and texts.

    Attributes:
        source: what is read.
        folder: that its name is relative to.
        scene: that it is laid out in.
        start_us: when episodes begin [us]; None: with the recording.
        names: parameters of the storyboard.
    """

    source: ScenarioSource
    folder: Path
    scene: Scene
    start_us: int | None
    names: frozenset[str]

    def read(self, values: Mapping[str, Value]) -> ScenarioFile:
        """The file with values of its parameters, in its own frame. Raises as :meth:`at`."""
        mine = {name: value for name, value in values.items() if name in self.names}
        found = read_scenario(self.source, self.folder, mine)
        # What the file draws is drawn by the space.
        fields = {"distributions": {}, "drives_ego": False}
        board = found.board.model_copy(update=fields)
        return ScenarioFile(board, found.road_file, found.notes)

    def at(self, values: Mapping[str, Value]) -> Storyboard:
        """The storyboard with values of its parameters, laid out in the scene.

        Raises:
            ValueError: values that the file does not allow.
        """
        try:
            return self.laid_out(self.read(values).board)
        except (ScenarioError, OSError) as error:
            raise ValueError(f"storyboard {self.source.file!r}: {error}") from error

    def laid_out(self, board: Storyboard) -> Storyboard:
        """A storyboard in the frame of its file, in the scene. Raises ScenarioError."""
        if self.source.as_it_is:
            return board
        return fitted_to_scene(board, self.scene, start_us=self.start_us)


def is_scenario(name: str) -> bool:
    """Whether a name is that of a scenario file or of a case of the gallery."""
    return name.startswith(GALLERY) or name.endswith(".xosc")


def read_scenario(
    source: ScenarioSource, folder: Path, parameters: Mapping[str, Any]
) -> ScenarioFile:
    """A scenario with values of its parameters.

    Raises:
        ScenarioError: no scenario, or something that is not supported.
        ValueError: a parameter that it does not have.
        OSError: it cannot be read.
    """
    if source.file.startswith(GALLERY):
        return ScenarioFile(corner_case(source.file).storyboard(**parameters))
    path = folder / source.file
    if (size := path.stat().st_size) > MOST_BYTES:
        raise ScenarioError(f"{size} bytes; at most {MOST_BYTES} are read")
    if path.suffix == ".json":
        fields = json.loads(path.read_text(encoding="utf-8"))
        fields["parameters"] = {**fields.get("parameters", {}), **parameters}
        return ScenarioFile(Storyboard.model_validate(fields))
    options = ReadOptions(parameters, frozenset(source.leave_out), source.ego)
    if source.alone:
        return read_openscenario_text(path.read_bytes(), path.name, options)
    return read_openscenario(path, options)


def write_scenario_file(
    folder: Path, name: str, read: ScenarioFile, source: ScenarioSource
) -> ScenarioSource:
    """Write a storyboard with the road network that it names; how it is read again.

    Args:
        folder: of the file.
        name: of the file, without its suffix: ``.xosc``, or ``.json`` where OpenSCENARIO has no
            words for it.
        read: in the frame of its file.
        source: that it was read from.
    """
    board = read.board
    if isinstance(board.roads, MapRoads) and read.road_file is not None:
        roads = f"{name}{read.road_file.suffix}"
        with atomic_file(folder / roads) as file:
            file.write(read.road_file.read_bytes())
        board = board.model_copy(update={"roads": MapRoads(file=roads)})
    try:
        suffix, content = ".xosc", write_openscenario(board)
    except ScenarioError:
        suffix, content = ".json", board.model_dump_json(indent=2).encode()
    with atomic_file(folder / f"{name}{suffix}") as file:
        file.write(content)
    return ScenarioSource(file=f"{name}{suffix}", ego=source.ego, as_it_is=source.as_it_is)


def run_options(board: Storyboard, *, seed: int, seconds: float) -> dict[str, Any]:
    """Options of the reset with which ``real2sim run`` drives a storyboard."""
    return {
        "storyboard": board.model_dump(mode="json"),
        "seed": seed,
        "horizon": max(round(seconds * 10), 1),
        "beyond_log": "extend",
    }


def with_storyboard(
    fields: Mapping[str, Any], folder: Path, scenes: Path | None = None
) -> dict[str, Any]:
    """Fields of a space whose ``storyboard`` names a scenario, with what makes storyboards of it.

    Parameters of the space that have no path are those of the storyboard of that name; those that
    the file draws from distributions need not be named.

    Args:
        fields: of the file.
        folder: that the name is relative to.
        scenes: folder of bundles, as of :func:`~.open_scene`.

    Raises:
        CommandError: no such scenario, or one that is no space; the sentence says why.
        ValueError: fields that are none.
    """
    asked = fields["storyboard"]
    source = ScenarioSource.model_validate({"file": asked} if isinstance(asked, str) else asked)
    case = {"name": _name(source.file), "scene": "demo_street", **(fields.get("case") or {})}
    reset = {
        "beyond_log": "extend",
        "horizon": round(SECONDS * 10),
        **(case.get("reset") or {}),
    }
    try:
        found = read_scenario(source, folder, {})
        scene = open_scene(str(case["scene"]), scenes)
    except (ScenarioError, BundleError, OSError, ValueError) as error:
        raise CommandError(f"storyboard {source.file!r}: {error}") from error
    names = frozenset(found.board.parameters)
    made = StoryboardSpace(source, folder, scene, reset.get("start_us"), names)
    parameters = _parameters(fields.get("parameters") or {}, found, source.file)
    return {
        **fields,
        "storyboard": made,
        "case": {**case, "reset": reset},
        "parameters": parameters,
    }


def _name(file: str) -> str:
    text = file.removeprefix(GALLERY) if file.startswith(GALLERY) else Path(file).stem
    return "".join(c if c.isalnum() or c in "_-" else "_" for c in text)[:60] or "scenario"


def _parameters(given: Mapping[str, Any], found: ScenarioFile, file: str) -> dict[str, Any]:
    """Those that the space names, and those that the file draws beside them."""
    board = found.board
    # What a space names itself may have any distribution in the file.
    drawn = {n: d for n, d in board.distributions.items() if n not in given}
    parameters = {name: _parameter(name, d) for name, d in drawn.items()}
    parameters |= {n: p for n, p in _of_cases(found.cases).items() if n not in given}
    parameters |= dict(given)
    if not parameters:
        raise CommandError(
            f"storyboard {file!r} has no distributions; name its parameters with their ranges in a "
            f"file, as docs/sweeps.md says: it has {', '.join(board.parameters) or 'none'}"
        )
    used = " ".join(str(p.get("expression", "")) for p in parameters.values() if _is(p))
    for name, parameter in parameters.items():
        known = name in board.parameters or name in used
        if _is(parameter) and parameter.get("path") is None and not known:
            raise CommandError(
                f"storyboard {file!r} has no parameter {name!r}; it has "
                f"{', '.join(board.parameters) or 'none'}"
            )
    return parameters


def _is(parameter: Any) -> bool:
    return isinstance(parameter, dict)


def _parameter(name: str, found: Distribution) -> dict[str, Any]:
    """A parameter of a space that is drawn as a storyboard's is."""
    if isinstance(found, Uniform):
        return {"kind": "float", "low": found.low, "high": found.high}
    if isinstance(found, Normal) and not found.log:
        std = math.sqrt(found.variance)
        low = found.mean - WIDTHS * std if found.low is None else found.low
        high = found.mean + WIDTHS * std if found.high is None else found.high
        return {"kind": "normal", "mean": found.mean, "std": std, "low": low, "high": high}
    if isinstance(found, ValueSet):
        return _choice(name, found.values)
    if isinstance(found, ValueRange):
        count = math.floor((found.high - found.low) / found.step + 1e-9) + 1
        values = [found.low + k * found.step for k in range(min(count, MOST_VALUES + 1))]
        return _choice(name, values)
    if isinstance(found, Choice) and len({v.weight for v in found.values}) == 1:
        return _choice(name, [v.value for v in found.values])
    kind = "log-normal" if isinstance(found, Normal) else found.kind
    raise CommandError(
        f"parameter {name!r} has a distribution ({kind}) that spaces do not have; give its range "
        f"in `parameters`: {name}: {{low: ..., high: ...}}"
    )


def _of_cases(cases: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Parameters of which the cases of a deterministic distribution are all combinations."""
    if not cases:
        return {}
    found = {name: list(dict.fromkeys(c[name] for c in cases)) for name in cases[0]}
    if math.prod(len(values) for values in found.values()) != len(cases):
        raise CommandError(
            f"the file's sets give {', '.join(found)} together, not each its values; name ranges "
            "in `parameters` instead"
        )
    return {name: _choice(name, values) for name, values in found.items()}


def _choice(name: str, values: Sequence[Any]) -> dict[str, Any]:
    if len(values) > MOST_VALUES:
        raise CommandError(
            f"parameter {name!r} has more than {MOST_VALUES} values; give its range in "
            f"`parameters`: {name}: {{low: ..., high: ...}}"
        )
    return {"kind": "choice", "values": list(values)}
