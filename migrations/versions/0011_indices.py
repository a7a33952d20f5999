"""Keep index files and files of coefficients, which serve all satellites."""

import sqlalchemy as sa
from alembic import op

from app.storage.database import JsonColumn, UtcDateTime

revision = "0011_indices"
down_revision = "0010_reading"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "index_file",
        sa.Column("id", sa.String(length=32), nullable=False),
        sa.Column("name", sa.String(length=8), nullable=False),
        sa.Column("format", sa.String(length=16), nullable=False),
        sa.Column("sha256", sa.String(length=64), nullable=False),
        sa.Column("rows", sa.Integer(), nullable=False),
        sa.Column("missing", sa.Integer(), nullable=False),
        sa.Column("first", UtcDateTime(), nullable=False),
        sa.Column("last", UtcDateTime(), nullable=False),
        sa.Column("content", sa.LargeBinary(), nullable=False),
        sa.Column("intervals", sa.LargeBinary(), nullable=False),
        sa.Column("created_at", UtcDateTime(), nullable=False),
        sa.Column("created_by", sa.String(length=32), nullable=True),
        sa.CheckConstraint("name IN ('RC', 'Dst', 'Kp')", name=op.f("ck_index_file_name")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_index_file")),
        sa.UniqueConstraint("sha256", name=op.f("uq_index_file_sha256")),
    )
    op.create_index(op.f("ix_index_file_created_at_id"), "index_file", ["created_at", "id"])
    op.create_index(op.f("ix_index_file_name_first"), "index_file", ["name", "first"])
    op.create_table(
        "field_file",
        sa.Column("id", sa.String(length=32), nullable=False),
        sa.Column("name", sa.String(length=200), nullable=True),
        sa.Column("sha256", sa.String(length=64), nullable=False),
        sa.Column("details", JsonColumn, nullable=False),
        sa.Column("content", sa.LargeBinary(), nullable=False),
        sa.Column("created_at", UtcDateTime(), nullable=False),
        sa.Column("created_by", sa.String(length=32), nullable=True),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_field_file")),
        sa.UniqueConstraint("sha256", name=op.f("uq_field_file_sha256")),
    )
    op.create_index(op.f("ix_field_file_created_at_id"), "field_file", ["created_at", "id"])


def downgrade() -> None:
    op.drop_table("field_file")
    op.drop_table("index_file")
