"""The reference backend: plain torch, float64, differentiable; the oracle of the others."""
