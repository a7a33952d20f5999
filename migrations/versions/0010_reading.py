"""Keep how a magnetometer's telemetry is written, and how each chunk was read; a chunk from before has none."""

import sqlalchemy as sa
from alembic import op

from app.storage.database import JsonColumn

revision = "0010_reading"
down_revision = "0009_connectors"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("magnetometer", sa.Column("nt_per_count", sa.Double(), nullable=True))
    op.add_column("magnetometer", sa.Column("time_format", sa.String(length=100), nullable=True))
    op.add_column("magnetometer", sa.Column("time_epoch", sa.String(length=40), nullable=True))
    op.add_column("magnetometer", sa.Column("fill_values", JsonColumn, nullable=True))
    op.add_column("magnetometer", sa.Column("validity_column", sa.String(length=200), nullable=True))
    op.add_column("magnetometer", sa.Column("valid_values", JsonColumn, nullable=True))
    op.add_column("chunk", sa.Column("reading", JsonColumn, nullable=True))


def downgrade() -> None:
    op.drop_column("chunk", "reading")
    for name in ("valid_values", "validity_column", "fill_values", "time_epoch", "time_format", "nt_per_count"):
        op.drop_column("magnetometer", name)
