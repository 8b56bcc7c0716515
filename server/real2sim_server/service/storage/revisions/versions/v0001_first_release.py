"""first release."""

revision = "0001"
down_revision = None


def upgrade() -> None:
    """Do nothing: a new store gets its tables from `storage.tables`."""
