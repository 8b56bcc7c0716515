"""Stage 0: builds a scene of Gaussians from a log without training."""
