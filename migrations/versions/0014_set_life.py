"""Keep until when the set in force is good by the trend of its magnetometer's sets."""

import sqlalchemy as sa
from alembic import op

from app.storage.database import UtcDateTime

revision = "0014_set_life"
down_revision = "0013_attention"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "set_life",
        sa.Column("satellite_id", sa.String(length=63), nullable=False),
        sa.Column("magnetometer_id", sa.String(length=63), nullable=False),
        sa.Column("parameter_set_id", sa.String(length=32), nullable=False),
        sa.Column("newest_set_id", sa.String(length=32), nullable=False),
        sa.Column("until", UtcDateTime(), nullable=True),
        sa.Column("share", sa.Double(), nullable=False),
        sa.Column("is_capped", sa.Boolean(), nullable=False),
        sa.ForeignKeyConstraint(
            ["satellite_id", "magnetometer_id"],
            ["magnetometer.satellite_id", "magnetometer.id"],
            name=op.f("fk_set_life_satellite_id_magnetometer_id"),
        ),
        sa.PrimaryKeyConstraint("satellite_id", "magnetometer_id", name=op.f("pk_set_life")),
    )


def downgrade() -> None:
    op.drop_table("set_life")
