"""The street that comes with the package: what the demo shows, and a worker that has no scenes."""

from __future__ import annotations

from pathlib import Path

SHIPPED_STREET = Path(__file__).parents[2] / "demo" / "street.r2s.zip"
"""A packed scene; ``python -m real2sim_server.demo.street`` makes it anew."""

DEMO_SCENE = "demo_street"
"""Its name where it is served."""
