"""The paper's experiments on vehicles of a scene, and the pictures they leave."""

from .film import draw_curves, views, write_film
from .film_plan import FilmPlan
from .setup import Experiment, scene_road
from .setups import set_up

__all__ = ["Experiment", "FilmPlan", "draw_curves", "scene_road", "set_up", "views", "write_film"]
