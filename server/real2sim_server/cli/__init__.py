"""The worker's part of the ``real2sim`` command: a module for each command, named after it.

This package is imported by every ``real2sim --help``, so its modules load nothing heavy: a command
imports what it needs when it runs.
"""

from . import (
    calibrate,
    demo,
    doctor,
    evaluate,
    evaluate_policy,
    export,
    export_dataset,
    film,
    fit,
    ground,
    import_,
    log_info,
    map,
    reconstruct,
    render,
    replay,
    run,
    serve,
    simulate,
    store,
    sweep,
    synth,
    token,
    track,
    train_policy,
    validate,
)
from .command import app

app.add_typer(token.app, name="token")
app.add_typer(store.app, name="store")

__all__ = [
    "app",
    "calibrate",
    "demo",
    "doctor",
    "evaluate",
    "evaluate_policy",
    "export",
    "export_dataset",
    "film",
    "fit",
    "ground",
    "import_",
    "log_info",
    "map",
    "reconstruct",
    "render",
    "replay",
    "run",
    "serve",
    "simulate",
    "store",
    "sweep",
    "synth",
    "token",
    "track",
    "train_policy",
    "validate",
]
