"""Give each job its place in the queue: jobs of one priority are taken in rounds, one of each satellite."""

import sqlalchemy as sa
from alembic import op

revision = "0005"
down_revision = "0004"
branch_labels = None
depends_on = None

WAITING = """
UPDATE job SET rank = -10000000 * priority + (
    SELECT count(*) FROM job AS before
    WHERE before.state = 'queued' AND before.priority = job.priority AND before.id < job.id
        AND coalesce(before.satellite_id, '') = coalesce(job.satellite_id, '')
)
WHERE state = 'queued'
"""


def upgrade() -> None:
    op.drop_index("ix_job_state_priority_id", "job")
    op.add_column("job", sa.Column("rank", sa.Integer(), nullable=False, server_default="0"))
    op.execute(WAITING)
    op.create_index("ix_job_state_rank_id", "job", ["state", "rank", "id"])
    op.create_index("ix_job_satellite_id_state_rank", "job", ["satellite_id", "state", "rank"])


def downgrade() -> None:
    op.drop_index("ix_job_satellite_id_state_rank", "job")
    op.drop_index("ix_job_state_rank_id", "job")
    op.drop_column("job", "rank")
    op.create_index("ix_job_state_priority_id", "job", ["state", "priority", "id"])
