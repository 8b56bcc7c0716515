"""The server's part of the ``real2sim`` command.

``real2sim --help`` imports this package, so its modules must load fast. Each command imports its
dependencies when it runs.
"""

from . import doctor, drive, export, logs, physics, policies, reconstruct, scene, serve, store
from .common import app

app.add_typer(store.token_app, name="token")
app.add_typer(store.app, name="store")

__all__ = [
    "app",
    "doctor",
    "drive",
    "export",
    "logs",
    "physics",
    "policies",
    "reconstruct",
    "scene",
    "serve",
    "store",
]
