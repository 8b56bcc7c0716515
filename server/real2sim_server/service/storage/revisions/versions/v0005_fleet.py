"""sessions and jobs may go from one worker to another; where Alembic begins."""

revision = "0005"
down_revision = None


def upgrade() -> None:
    """Nothing: older stores are brought here by `storage.older`, new ones are made as they are."""
