"""Indexes for large fleets: of the sessions whose bytes are kept, for retention, and of each set's activations."""

import sqlalchemy as sa
from alembic import op

revision = "0019_large_fleet"
down_revision = "0018_seen_samples"
branch_labels = None
depends_on = None

KEPT = sa.text("raw_removed_at IS NULL AND state = 'closed'")


def upgrade() -> None:
    op.create_index(
        "ix_session_kept", "session", ["satellite_id", "data_until"], sqlite_where=KEPT, postgresql_where=KEPT
    )
    op.create_index(op.f("ix_activation_parameter_set_id"), "activation", ["parameter_set_id"])


def downgrade() -> None:
    op.drop_index(op.f("ix_activation_parameter_set_id"), "activation")
    op.drop_index("ix_session_kept", "session")
