"""The CUDA backend: gsplat behind the same call."""
