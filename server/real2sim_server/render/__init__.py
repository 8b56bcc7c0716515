"""From Gaussians to pictures: one rasterize() call, three backends."""
