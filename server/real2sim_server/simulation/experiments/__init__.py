"""The paper's experiments on vehicles of a scene, and the pictures they leave."""

from .film import draw_curves, views, walls, write_film
from .setups import Experiment, scene_road, set_up

__all__ = ["Experiment", "draw_curves", "scene_road", "set_up", "views", "walls", "write_film"]
