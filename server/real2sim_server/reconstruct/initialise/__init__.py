"""Stage 0: from a log to a scene of Gaussians without training."""
