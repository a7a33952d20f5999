"""Pulls remember which rows they took, so that they can look back for those that come late."""

import sqlalchemy as sa
from alembic import op

from app.storage.database import UtcDateTime

revision = "0018_seen_samples"
down_revision = "0017_asked_objects"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "connector_seen",
        sa.Column("id", sa.String(length=32), nullable=False),
        sa.Column("name", sa.String(length=200), nullable=False),
        sa.Column("satellite_id", sa.String(length=63), nullable=False),
        sa.Column("until", UtcDateTime(), nullable=False),
        sa.Column("times", sa.LargeBinary(), nullable=False),
        sa.ForeignKeyConstraint(["satellite_id"], ["satellite.id"], name=op.f("fk_connector_seen_satellite_id")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_connector_seen")),
    )
    op.create_index(op.f("ix_connector_seen_name_until"), "connector_seen", ["name", "until"])
    with op.batch_alter_table("connector_mark") as batch:
        batch.add_column(sa.Column("remembers_from", UtcDateTime(), nullable=True))
        batch.add_column(sa.Column("looked_back_at", UtcDateTime(), nullable=True))


def downgrade() -> None:
    with op.batch_alter_table("connector_mark") as batch:
        batch.drop_column("looked_back_at")
        batch.drop_column("remembers_from")
    op.drop_index(op.f("ix_connector_seen_name_until"), "connector_seen")
    op.drop_table("connector_seen")
