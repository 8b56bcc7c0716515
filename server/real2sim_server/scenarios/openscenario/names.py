"""Words of OpenSCENARIO for those of the storyboard."""

from __future__ import annotations

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


def back(words: dict[str, str], word: str) -> str:
    """The first word of OpenSCENARIO for one of the storyboard."""
    return next(theirs for theirs, ours in words.items() if ours == word)
