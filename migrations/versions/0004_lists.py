"""Find what lists, quotas and times ask for without walking through a whole history."""

from alembic import op

revision = "0004"
down_revision = "0003"
branch_labels = None
depends_on = None

INDEXES = {
    "parameter_set": [["satellite_id", "id"]],
    "session": [["satellite_id", "id"], ["satellite_id", "magnetometer_id", "id"]],
    "job": [["created_by", "state"], ["state", "id"]],
    "chunk": [["created_at"]],
}


def upgrade() -> None:
    for table, indexes in INDEXES.items():
        for columns in indexes:
            op.create_index(f"ix_{table}_{'_'.join(columns)}", table, columns)
    op.drop_index("ix_job_created_by", "job")


def downgrade() -> None:
    op.create_index("ix_job_created_by", "job", ["created_by"])
    for table, indexes in INDEXES.items():
        for columns in indexes:
            op.drop_index(f"ix_{table}_{'_'.join(columns)}", table)
