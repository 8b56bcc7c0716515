"""Top views of corner cases with the paths of all entities and their meeting point.

``python -m real2sim_server.scenarios.picture`` writes the shipped pictures into
``scenarios/pictures``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple
from xml.sax.saxutils import escape

from real2sim_proto.episode import ResetSpec
from real2sim_proto.storyboard import Storyboard

from ..edit import ScenarioState
from ..scene import Scene
from ..world import World
from .flat_scene import fitted_to_scene, flat_scene
from .gallery import GALLERY, PICTURES, CornerCase, corner_case

EGO_SPEED = 10.0
"""Speed of the ego, straight ahead, in the pictures [m/s]."""

MAX_DURATION_S = 12.0
LANE, MARGIN = 3.5, 6.0
MAX_WIDTH_M = 20.0
"""Maximum distance to either side of the ego's lane [m]."""

ASPECT = 3.0
"""Aspect ratio (width by height) of all pictures."""

ASPHALT, GRASS, PAINT = "#8b8f94", "#c9d3bd", "#f2f2ee"
EGO, OTHERS = "#2166d1", ("#c8402e", "#d68a1c", "#7b3fa0")


class BoxPose(NamedTuple):
    """Pose of an entity at an instant: centre of the box [m], heading [rad]."""

    x: float
    y: float
    heading: float


class DrivenBox(NamedTuple):
    """Path of an entity through a case.

    Attributes:
        size: length and width [m].
        poses: one per time step.
    """

    size: tuple[float, float]
    poses: list[BoxPose]


def picture_of(case: CornerCase, scene: Scene) -> str:
    """An SVG document of a case.

    The ego drives straight ahead. All entities are shown from the start (pale) until the ego meets
    one of them, or has passed.

    Args:
        case: case of the gallery, with default parameters.
        scene: a scene like that of :func:`plain_scene`.
    """
    return _drawn(case.title, _courses(case, scene))


def plain_scene() -> Scene:
    """A straight road with lanes for the pictures."""
    return flat_scene(_with_speed(corner_case("ccrs").storyboard()))


def main() -> None:
    """Write the pictures of all cases."""
    scene = plain_scene()
    for case in GALLERY.values():
        (PICTURES / f"{case.name}.svg").write_text(picture_of(case, scene), encoding="utf-8")


# --- paths --------------------------------------------------------------------------------------


def _with_speed(board: Storyboard) -> Storyboard:
    fields = board.model_dump()
    speed = {"entity": "Ego", "action": {"kind": "speed", "speed": EGO_SPEED}}
    return Storyboard.model_validate(fields | {"init": [*fields["init"], speed]})


def _courses(case: CornerCase, scene: Scene) -> list[DrivenBox]:
    """Paths of all entities, the ego first; relative to its start."""
    board = fitted_to_scene(_with_speed(case.storyboard()), scene)
    spec = ResetSpec(
        storyboard=board.model_copy(update={"drives_ego": True}),
        horizon=round(MAX_DURATION_S * 10),
        action="pose",
        contact={"dents": False},
    )
    world = World(scene, ScenarioState.of(scene), spec)
    origin = world.motion
    courses: dict[str, DrivenBox] = {}
    while True:
        assert world.storyboard is not None
        for name, actor in world.storyboard.entities.items():
            ahead = actor.centre[0]
            x = actor.x + ahead * math.cos(actor.h) - origin.x
            y = actor.y + ahead * math.sin(actor.h) - origin.y
            course = courses.setdefault(name, DrivenBox((actor.size[0], actor.size[1]), []))
            course.poses.append(BoxPose(x, y, actor.h))
        if world.over or _passed(list(courses.values())):
            break
        world.step()
    return [courses.pop("Ego"), *courses.values()]


def _passed(courses: Sequence[DrivenBox]) -> bool:
    """Whether the ego, the first entity, has passed all others that it could meet."""
    ego, *others = courses
    rear = ego.poses[-1].x - ego.size[0]
    behind = all(o.poses[-1].x + o.size[0] / 2 < rear and o.poses[0].x > 0 for o in others)
    return bool(others) and behind


# --- drawing ------------------------------------------------------------------------------------


def _drawn(title: str, courses: Sequence[DrivenBox]) -> str:
    everywhere = [s for course in courses for s in course.poses if abs(s.x) < 1e3]
    low, high = (f(s.x for s in everywhere) for f in (min, max))
    across = min(max(abs(s.y) for s in everywhere) + 2.0, MAX_WIDTH_M)
    width = max(high - low + 2 * MARGIN, 2 * ASPECT * across)
    low, half = (low + high - width) / 2, width / ASPECT / 2
    high = low + width
    colours = [EGO, *(OTHERS[k % len(OTHERS)] for k in range(len(courses) - 1))]
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="{low:.1f} {-half:.1f} '
        f'{high - low:.1f} {2 * half:.1f}" role="img">',
        f"<title>{escape(title)}</title>",
        *_road(low, high, half),
        *(_way(c, colour) for c, colour in zip(courses, colours, strict=True)),
        *(_box(c, 0, colour, 0.35) for c, colour in zip(courses, colours, strict=True)),
        *(_box(c, -1, colour, 1.0) for c, colour in zip(courses, colours, strict=True)),
        "</svg>",
    ]
    return "\n".join(parts) + "\n"


def _road(low: float, high: float, half: float) -> list[str]:
    """The ego's lane, the next one on its left, and the surroundings; y points down in pictures."""
    width = high - low
    found = [
        f'<rect x="{low:.1f}" y="{-half:.1f}" width="{width:.1f}" height="{2 * half:.1f}" '
        f'fill="{GRASS}"/>',
        f'<rect x="{low:.1f}" y="{-1.5 * LANE - 0.5:.2f}" width="{width:.1f}" '
        f'height="{2 * LANE + 1.0:.2f}" fill="{ASPHALT}"/>',
    ]
    for y, dashes in ((-1.5 * LANE, ""), (-0.5 * LANE, ' stroke-dasharray="3 6"'), (LANE / 2, "")):
        line = f"M{low:.1f} {y:.2f}H{high:.1f}"
        found.append(f'<path d="{line}" stroke="{PAINT}" stroke-width="0.15"{dashes}/>')
    return found


def _way(course: DrivenBox, colour: str) -> str:
    points = " ".join(f"{s.x:.1f},{-s.y:.1f}" for s in course.poses[::2])
    return (
        f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="0.3" '
        'stroke-dasharray="0.8 0.6"/>'
    )


def _box(course: DrivenBox, at: int, colour: str, opacity: float) -> str:
    """A box with its front pointed."""
    x, y, heading = course.poses[at]
    length, width = (max(v, 0.9) / 2 for v in course.size)
    nose = min(0.8, length / 2)
    corners = (
        (-length, -width), (length - nose, -width), (length, 0.0), (length - nose, width),
        (-length, width),
    )  # fmt: skip
    cos, sin = math.cos(heading), math.sin(heading)
    points = " ".join(
        f"{x + a * cos - b * sin:.2f},{-(y + a * sin + b * cos):.2f}" for a, b in corners
    )
    return f'<polygon points="{points}" fill="{colour}" fill-opacity="{opacity}"/>'


if __name__ == "__main__":
    main()
