"""Bodies that meet: momentum exchanged, what is struck slides to rest."""

from .body import Body, Solid, slid
from .dents import Dents
from .model import Deformation, Impact, Wreck, ego_body, ego_motion, ego_solid
from .resolve import Bout, Outcome, resolve
from .touch import Exchange, Touch, corners, exchange, touch

__all__ = [
    "Body",
    "Bout",
    "Deformation",
    "Dents",
    "Exchange",
    "Impact",
    "Outcome",
    "Solid",
    "Touch",
    "Wreck",
    "corners",
    "ego_body",
    "ego_motion",
    "ego_solid",
    "exchange",
    "resolve",
    "slid",
    "touch",
]
