"""The words of the field, as a test: one word per concept.

A word that was replaced by the field's own stands here with the one that took its place, so that
it does not come back. Names on the wire are strings and are not looked at.
"""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]
FOLDERS = ("proto/real2sim_proto", "client", "server", "tests", "docs", "docker")
PAGES = ("README.md", "ARCHITECTURE.md", "CONTRIBUTING.md")
SUFFIXES = {".py", ".md", ".js", ".html", ".yml"}

NAMES = {
    # physics and simulation
    "Actor": "DeformableBody",
    "actors": "bodies",
    "Tape": "TrajectoryRecorder",
    "Ledger": "ContactLog",
    "ledger": "contact log",
    "Jelly": "FixedCorotated",
    "Blowup": "SolverDiverged",
    "Crasher": "ImpactBody",
    "loosen": "activate",
    "stiffen": "rigidify",
    "lay_down": "put_to_sleep",
    "unrest": "residual_speed",
    "calm_for": "settle_time",
    "still_for": "sleep_time",
    "RESTING": "SLEEPING",
    "strayed": "needs_resort, off_route",
    "meet_bodies": "resolve_body_contact",
    "meet_colliders": "resolve_collider_contact",
    "rubbed": "friction_work",
    "SOFTER": "stiffness scale",
    "RINGS": "SETTLING_TIME",
    "TICK": "SAMPLE_DT",
    # world
    "judging": "evaluation",
    "Unjudged": "PendingStep",
    "Tally": "MetricAccumulator",
    "tally": "accumulator",
    "blows": "impulses",
    "Aftermath": "StepContacts",
    "aftermath": "step contacts",
    "Pilot": "EgoController",
    "pilot": "controller",
    "Bout": "CollisionStep",
    "run_bout": "solve_collisions",
    "Wreck": "ImpactedObject",
    "wrecks": "impacted objects",
    "Dents": "DeformationTracker",
    "Retold": "Replayer",
    "_happen": "apply",
    "light_copy": "fork",
    "LEFT_LOG": "OFF_ROUTE",
    # service
    "Pictured": "RenderedFrames",
    "Patience": "DeadlineTimer",
    "Residency": "SceneCache",
    "residency": "scene cache",
    "HeldScenario": "CachedScenario",
    "HeldScenarios": "ScenarioCache",
    "held_scenarios": "scenario cache",
    "put_aside": "evict",
    "GREETING_S": "HANDSHAKE_TIMEOUT_S",
    "FAREWELL_S": "CLOSE_TIMEOUT_S",
    "_hang_up": "close_with_error",
    "Parted": "scatter-gather send",
    # training, reconstruction, logs
    "guesses": "priors",
    "shreds": "floaters",
    "buried": "occluded",
    "own_paint": "body_color",
    "strangers": "unmatched",
    # edit
    "snapped": "snap_to_ground",
    "dressed": "with appearance",
    "uncovered": "ground inpainting",
    # client
    "patient": "long_timeout",
    "_conversation": "protocol state",
}
"""Identifiers, also as words of prose."""

MEMBERS = {
    "judge": "evaluate",
    "kick": "apply_impulse",
    "told": "with_plan",
    "looks": "views",
    "falling": "exponential_decay",
    "hear": "handle_unsolicited",
}
"""Plain English that may stand in a sentence, but names no function or attribute."""

CLASSES = {
    "Stage": "HybridSimulator",
    "Coming": "PendingPlan",
    "Hold": "ConstantCommand",
    "Put": "Teleport",
    "Course": "PlannedTrajectory",
    "Met": "EgoContacts",
    "Show": "ObservationRenderer",
    "Shown": "EncodedObservation",
    "Drawn": "RenderedObservation",
    "Pictures": "Renderer",
    "Shot": "RenderRequest",
    "Library": "SceneCatalog",
    "Ticket": "JobContext",
    "Once": "IdempotentRequest",
    "Thing": "LogRecord",
    "Conversation": "ProtocolState",
    "Question": "PendingRequest",
}
"""Names that no class has."""

PHRASES = {
    r"\b(?:higher|lower|every|each|all|this|the) (?:\w+ )?rooms?\b(?! for\b|\.$)": "package",
    r"\brooms of the code\b|\brooms drawn\b": "package",
    r"\bways of the data\b": "data flow",
    r"\bphysics[./]laws\b|\blaws\.\w": "constitutive",
    r"\b(?:async|sync|its) twins?\b": "async variant",
}
"""Prose, as patterns."""


def patterns() -> dict[str, re.Pattern[str]]:
    """What is looked for, by kind."""
    names, members, classes = ("|".join(words) for words in (NAMES, MEMBERS, CLASSES))
    return {
        "names": re.compile(rf"(?<![\w'\"-])(?:{names})(?![\w'\"-])"),
        "members": re.compile(rf"(?:\bdef |(?<=[\w)\]])\.)(?:{members})\("),
        "classes": re.compile(rf"\bclass (?:{classes})\b"),
        "phrases": re.compile("|".join(PHRASES)),
    }


@cache
def lines() -> list[tuple[str, str]]:
    """Place and text of every line that is looked at."""
    files = [
        path
        for folder in FOLDERS
        for path in sorted((REPOSITORY / folder).rglob("*"))
        if path.suffix in SUFFIXES and "node_modules" not in path.parts
    ]
    return [
        (f"{path.relative_to(REPOSITORY)}:{number}", line)
        for path in (*files, *(REPOSITORY / page for page in PAGES))
        if path != Path(__file__)
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1)
    ]


@pytest.mark.parametrize("kind", patterns())
def test_words_that_were_replaced_stay_away(kind):
    pattern = patterns()[kind]
    found = [
        f"{place}: {match.group()!r} in {line.strip()[:90]}"
        for place, line in lines()
        if (match := pattern.search(line))
    ]
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    ("kind", "line"),
    [
        ("names", "            body.loosen()"),
        ("names", "from .ledger import Ledger"),
        ("members", "        return world.judge()"),
        ("classes", "class Show:"),
        ("phrases", '"""Errors of the physics room."""'),
    ],
)
def test_a_word_that_came_back_is_found(kind, line):
    assert patterns()[kind].search(line)


@pytest.mark.parametrize(
    ("kind", "line"),
    [
        ("names", 'MATERIALS = {"jelly": jelly, "ledger": 1}'),
        ("members", "where the judge of a race is told, that is a sentence"),
        ("classes", "class ShowOptions:"),
        ("phrases", "the oldest makes room for the next"),
    ],
)
def test_wire_names_and_plain_english_are_let_through(kind, line):
    assert not patterns()[kind].search(line)
