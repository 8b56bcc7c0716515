"""The paper's experiments and crash tests with vehicles of a scene, and their films."""

from .film import FilmPlan, draw_curves, views, write_film
from .setups import Experiment, scene_road, set_up

__all__ = ["Experiment", "FilmPlan", "draw_curves", "scene_road", "set_up", "views", "write_film"]
