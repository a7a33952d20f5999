"""Name the moments of a parameter set's fit, from which it is made again; a set from before has none."""

import sqlalchemy as sa
from alembic import op

revision = "0006"
down_revision = "0005"
branch_labels = None
depends_on = None

LEFT_BY_A_DOWNGRADE = """
UPDATE parameter_set SET moments_sha256 = (
    SELECT blob.sha256 FROM blob WHERE blob.key = 'moments/' || parameter_set.id
)
"""


def upgrade() -> None:
    op.add_column("parameter_set", sa.Column("moments_sha256", sa.String(length=64), nullable=True))
    op.execute(LEFT_BY_A_DOWNGRADE)


def downgrade() -> None:
    op.drop_column("parameter_set", "moments_sha256")
