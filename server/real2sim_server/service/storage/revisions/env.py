"""Alembic's environment: runs the revisions of this folder on a given connection.

A worker and ``real2sim store migrate`` pass the connection that holds the schema lock, see
:mod:`..schema`. To write a revision, set ``REAL2SIM_STORE_URL`` and run ``alembic revision``.
"""

import os

import sqlalchemy as sa
from alembic import context

from real2sim_server.service.storage import schema


def run(connection: sa.Connection) -> None:
    """Run all revisions up to the requested one, within the connection's transaction."""
    on_step = context.config.attributes.get("on_step")
    context.configure(
        connection=connection,
        target_metadata=schema.metadata,
        on_version_apply=on_step,
        # SQLite changes a column by copying its table.
        render_as_batch=connection.dialect.name == "sqlite",
    )
    with context.begin_transaction():
        context.run_migrations()


given = context.config.attributes.get("connection")
if given is not None:
    run(given)
else:
    with sa.create_engine(os.environ["REAL2SIM_STORE_URL"]).begin() as own:
        run(own)
