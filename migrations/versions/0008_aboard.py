"""Keep what is known to be aboard."""

import sqlalchemy as sa
from alembic import op

from app.storage.database import JsonColumn, UtcDateTime

revision = "0008_aboard"
down_revision = "0007_outbox"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "aboard_report",
        sa.Column("id", sa.String(length=32), nullable=False),
        sa.Column("parameter_set_id", sa.String(length=32), nullable=False),
        sa.Column("satellite_id", sa.String(length=63), nullable=False),
        sa.Column("magnetometer_id", sa.String(length=63), nullable=False),
        sa.Column("state", sa.String(length=16), nullable=False),
        sa.Column("comparison", JsonColumn, nullable=True),
        sa.Column("matches_parameter_set_id", sa.String(length=32), nullable=True),
        sa.Column("created_at", UtcDateTime(), nullable=False),
        sa.Column("created_by", sa.String(length=32), nullable=True),
        sa.CheckConstraint(
            "state IN ('exported', 'uploaded', 'confirmed', 'different')", name=op.f("ck_aboard_report_state")
        ),
        sa.ForeignKeyConstraint(
            ["parameter_set_id"], ["parameter_set.id"], name=op.f("fk_aboard_report_parameter_set_id")
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_aboard_report")),
    )
    for columns in (["parameter_set_id", "id"], ["satellite_id", "magnetometer_id", "id"]):
        op.create_index(op.f(f"ix_aboard_report_{'_'.join(columns)}"), "aboard_report", columns)


def downgrade() -> None:
    op.drop_table("aboard_report")
