"""The paper's experiments on vehicles of a scene, and the pictures they leave."""

from .film import FilmPlan, draw_curves, views, write_film
from .setups import Experiment, scene_road, set_up

__all__ = ["Experiment", "FilmPlan", "draw_curves", "scene_road", "set_up", "views", "write_film"]
