"""Keep the version of each job's request, so that a worker takes no job of a later release."""

import sqlalchemy as sa
from alembic import op

revision = "0015_request_version"
down_revision = "0014_set_life"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("job", sa.Column("request_version", sa.Integer(), nullable=False, server_default="1"))


def downgrade() -> None:
    op.drop_column("job", "request_version")
