"""An entity a short time later."""

from __future__ import annotations

from ..evolve import evolved
from .entity_state import EntityState, Moved, coasting
from .view import View


def advanced(actor: EntityState, view: View, h: float) -> EntityState:
    """An entity ``h`` seconds on, moved by what its actions say; the planner's ego as it goes."""
    if not actor.scripted:
        return coasting(actor, h)
    control = actor.longitudinal
    held = Moved(actor.speed * h, actor.speed, None)
    moved = held if control is None else control.step(actor, view, h)
    finished = actor.finished
    if control is not None and moved.then is None:
        finished |= {control.token}
    rate = (moved.speed - actor.speed) / h
    actor = evolved(
        actor, longitudinal=moved.then, speed=moved.speed, acceleration=rate, finished=finished
    )
    if actor.trajectory is not None:
        return _on_trajectory(actor, view, moved.way, h)
    return _on_way(actor, view, moved.way, h)


def _on_way(actor: EntityState, view: View, way: float, h: float) -> EntityState:
    control, offset, then, finished = actor.lateral, actor.offset, None, actor.finished
    if control is not None:
        offset, then = control.step(actor, view, way, h)
        if then is None:
            finished |= {control.token}
    return evolved(
        actor,
        s=actor.s + way,
        offset=offset,
        drift=(offset - actor.offset) / h,
        lateral=then,
        finished=finished,
        travelled=actor.travelled + abs(way),
    ).placed()


def _on_trajectory(actor: EntityState, view: View, way: float, h: float) -> EntityState:
    before = actor.trajectory
    assert before is not None
    way, then = before.step(way, h)
    travelled = actor.travelled + abs(way)
    if before.timing is not None:
        speed = way / h
        actor = evolved(actor, speed=speed, acceleration=(speed - actor.speed) / h)
    if then is not None:
        place = then.place() if then.begun() else None
        if place is None:
            return evolved(actor, trajectory=then)
        return evolved(
            actor, trajectory=then, x=place.x, y=place.y, h=place.h, travelled=travelled, drift=0.0
        )
    end = before.course.at(before.course.length)
    beyond = max(before.s + way - before.course.length, 0.0) if before.timing is None else 0.0
    done = evolved(actor, finished=actor.finished | {before.token}, travelled=travelled)
    put = done.put(end, view.network)
    return evolved(put, s=put.s + beyond).placed() if put.way is not None and beyond else put
