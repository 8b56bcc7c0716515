"""Small images from merged Gaussians: clouds in several levels of detail, and the pictures drawn
from as much of them as the pixels show."""
