"""Between pictures and matter: Gaussians that follow particles, bodies rigid or deforming."""

from .embedding import Deformed, Embedding, deform_cloud, stretched
from .rigid import RigidMotion, best_rotation
from .tyres import Tyres

__all__ = [
    "Deformed",
    "Embedding",
    "RigidMotion",
    "Tyres",
    "best_rotation",
    "deform_cloud",
    "stretched",
]
