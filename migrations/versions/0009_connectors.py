"""Keep what connectors asked of other services, which of those must not be asked, and how far pulls have come."""

import sqlalchemy as sa
from alembic import op

from app.storage.database import UtcDateTime

revision = "0009_connectors"
down_revision = "0008_aboard"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "connector_request",
        sa.Column("id", sa.String(length=32), nullable=False),
        sa.Column("source", sa.String(length=32), nullable=False),
        sa.Column("satellite_id", sa.String(length=63), nullable=False),
        sa.Column("asked_at", UtcDateTime(), nullable=False),
        sa.Column("outcome", sa.String(length=500), nullable=True),
        sa.ForeignKeyConstraint(["satellite_id"], ["satellite.id"], name=op.f("fk_connector_request_satellite_id")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_connector_request")),
    )
    for columns in (["source", "satellite_id", "asked_at"], ["source", "asked_at"]):
        op.create_index(op.f(f"ix_connector_request_{'_'.join(columns)}"), "connector_request", columns)
    op.create_table(
        "connector_stop",
        sa.Column("source", sa.String(length=32), nullable=False),
        sa.Column("reason", sa.String(length=500), nullable=False),
        sa.Column("stopped_at", UtcDateTime(), nullable=False),
        sa.PrimaryKeyConstraint("source", name=op.f("pk_connector_stop")),
    )
    op.create_table(
        "connector_mark",
        sa.Column("name", sa.String(length=200), nullable=False),
        sa.Column("mark", sa.Text(), nullable=False),
        sa.Column("updated_at", UtcDateTime(), nullable=False),
        sa.PrimaryKeyConstraint("name", name=op.f("pk_connector_mark")),
    )


def downgrade() -> None:
    for name in ("connector_mark", "connector_stop", "connector_request"):
        op.drop_table(name)
