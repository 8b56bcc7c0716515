"""The text that is compiled: constants and functions shared with the CPU, then the kernels."""

from __future__ import annotations

import functools
import inspect
from pathlib import Path

from ...constitutive import material_row, stress
from ...contact import collider_distance, node, particle
from ...numerics import splines
from .translate import Kind, Translator

FOLDER = Path(__file__).parent / "kernels"
SOURCE = FOLDER / "solver.cu"
KERNELS = (
    "begin_run",
    "find_keys",
    "count_digits",
    "sum_digits",
    "scatter_digits",
    "reorder",
    "mark_blocks",
    "add_pieces",
    "sum_pieces",
    "spread_sums",
    "fill_blocks",
    "mark_fields",
    "fill_fields",
    "link_fields",
    "mark_lists",
    "fill_lists",
    "find_near",
    "advance_blocks",
    "advance_obstructed",
    "collect_fields",
    "measure_blocks",
    "measure_bodies",
    "sum_contacts",
    "add_totals",
)
PRECISIONS = {"single": "float", "double": "double"}
_THREE: Kind = ("real",) * 3
_SIX: Kind = ("real",) * 6
_NINE: Kind = ("real",) * 9
_CONSTANTS = {
    material_row: ("LAW", "MU", "LAMBDA", "VISCOSITY", "PLASTIC", "MATERIAL_ROW"),
    collider_distance: ("KIND", "HEIGHT_FIELD", "THIN", "COLLIDER_ROW"),
}


@functools.cache
def solver_source(precision: str) -> str:
    """C++ of all kernels for a precision, ``single`` or ``double``; includes files of FOLDER."""
    constants = [
        f"constexpr unsigned {name} = {getattr(module, name)};"
        for module, names in _CONSTANTS.items()
        for name in names
    ]
    parts = [
        f"typedef {PRECISIONS[precision]} real;",
        '#include "numbers.h"',
        *constants,
        f"namespace laws {{\n{_laws()}\n}}",
        f"namespace contact {{\n{_contact()}\n}}",
        SOURCE.read_text(encoding="ascii"),
    ]
    return "\n".join(parts)


def _laws() -> str:
    """What happens at one particle, in the precision of the state."""
    made = Translator("real", "law_")
    made.add(stress.stress_update, (_NINE, "real", "rows", "real"))
    made.add(stress.add_viscosity, (_SIX, _NINE, "real", "real"))
    made.add(stress.advance_gradient, (_NINE, _NINE, "real"))
    made.add(stress.wave_hardening, ("real", "rows"))
    made.add(splines.spline_weights, ("real",))
    return made.text


def _contact() -> str:
    """What happens at one node, or one particle near a thin collider, in double precision."""
    made = Translator("double", "contact_")
    place: tuple[Kind, ...] = ("rows", "rows", "real", "real", _THREE, "row", "rows", "row")
    made.add(node.resolve_node_collider, place)
    pair: tuple[Kind, ...] = ("row", "row", "rows", "rows", "real", "real", _THREE, "row", "row")
    made.add(node.resolve_node_pair, pair)
    made.add(node.pair_friction, ("real", "real"))
    touch: list[Kind] = ["rows", "real", "real", "real", _THREE, _THREE, "real", "row"]
    wide = "heights" in inspect.signature(particle.resolve_particle_collider).parameters
    if wide:
        touch.insert(1, "rows")
    made.add(particle.resolve_particle_collider, touch)
    given = "row, heights, " if wide else "row, "
    macro = (
        f"#define TOUCH_PARTICLE(row, heights, ...) resolve_particle_collider({given}__VA_ARGS__)"
    )
    return f"{made.text}\n{macro}"
