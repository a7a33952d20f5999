"""Keep over which time a magnetometer averages a reading; one from before does not say."""

import sqlalchemy as sa
from alembic import op

revision = "0016_integration"
down_revision = "0015_request_version"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("magnetometer", sa.Column("integration_s", sa.Double(), nullable=True))


def downgrade() -> None:
    op.drop_column("magnetometer", "integration_s")
