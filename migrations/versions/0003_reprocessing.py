"""Find the calibrations of a reprocessing by their state."""

from alembic import op

revision = "0003"
down_revision = "0002"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.drop_index("ix_job_parent_id", "job")
    op.create_index("ix_job_parent_id_state", "job", ["parent_id", "state"])


def downgrade() -> None:
    op.drop_index("ix_job_parent_id_state", "job")
    op.create_index("ix_job_parent_id", "job", ["parent_id"])
