"""One open activation a magnetometer; objects that are to be removed; which database this is.

Activations that two writers made at once are put in order: of those that are open the last stays so, and a set that
stands as its own predecessor gets the one before it.
"""

import sqlalchemy as sa
from alembic import op

from app.storage.database import UtcDateTime

revision = "0012_two_writers"
down_revision = "0011_indices"
branch_labels = None
depends_on = None

OPEN = sa.text("ended_at IS NULL")
CLOSE_ALL_BUT_THE_LAST = """
UPDATE activation SET ended_at = (
    SELECT min(later.begun_at) FROM activation AS later
    WHERE later.satellite_id = activation.satellite_id AND later.magnetometer_id = activation.magnetometer_id
    AND later.ended_at IS NULL AND (later.begun_at, later.id) > (activation.begun_at, activation.id)
)
WHERE ended_at IS NULL
"""
SKIP_ITSELF = """
UPDATE activation SET previous_id = (
    SELECT own.previous_id FROM activation AS own WHERE own.id = activation.previous_id
)
WHERE EXISTS (
    SELECT 1 FROM activation AS own
    WHERE own.id = activation.previous_id AND own.parameter_set_id = activation.parameter_set_id
)
"""


def upgrade() -> None:
    op.create_table(
        "object_to_remove",
        sa.Column("key", sa.String(length=200), nullable=False),
        sa.Column("satellite_id", sa.String(length=63), nullable=False),
        sa.Column("created_at", UtcDateTime(), nullable=False),
        sa.PrimaryKeyConstraint("key", name="pk_object_to_remove"),
    )
    op.create_index("ix_object_to_remove_satellite_id", "object_to_remove", ["satellite_id"])
    op.create_table(
        "service_identity",
        sa.Column("database_id", sa.String(length=32), nullable=False),
        sa.Column("store", sa.String(length=16), nullable=False),
        sa.Column("created_at", UtcDateTime(), nullable=False),
        sa.PrimaryKeyConstraint("database_id", name="pk_service_identity"),
    )
    connection = op.get_bind()
    connection.execute(sa.text(CLOSE_ALL_BUT_THE_LAST))
    while connection.execute(sa.text(SKIP_ITSELF)).rowcount > 0:
        pass
    op.create_index(
        "ux_activation_open",
        "activation",
        ["satellite_id", "magnetometer_id"],
        unique=True,
        sqlite_where=OPEN,
        postgresql_where=OPEN,
    )


def downgrade() -> None:
    op.drop_index("ux_activation_open", "activation")
    op.drop_table("service_identity")
    op.drop_index("ix_object_to_remove_satellite_id", "object_to_remove")
    op.drop_table("object_to_remove")
