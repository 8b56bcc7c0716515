"""How the interpreter looks for garbage in a process that is a worker and nothing else.

A search through all objects takes 0.2 s, in which no session is answered. By the interpreter's own
settings one is due every few thousand steps: each leaves worlds and messages that live through two
small searches. Nearly all that is searched through was there before the first step and stays.
"""

from __future__ import annotations

import gc

YOUNG = 20_000
"""New objects between two small searches; a step makes some 200, nearly all of which go by
themselves."""


def search_seldom() -> None:
    """Let many steps pass between searches."""
    gc.set_threshold(YOUNG, *gc.get_threshold()[1:])


def spare_what_is_there() -> None:
    """Search no more through what is there now. Once, when a worker has all that it starts with:
    what of it becomes garbage in a cycle stays."""
    gc.collect(1)
    gc.freeze()
