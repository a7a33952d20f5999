"""Keep judgements of sessions, limits of age, withdrawn orbits, acknowledgements, notes, and reasons in the audit."""

import sqlalchemy as sa
from alembic import op

from app.storage.database import JsonColumn, UtcDateTime

revision = "0013_attention"
down_revision = "0012_two_writers"
branch_labels = None
depends_on = None

ADDED = (
    ("satellite", sa.Column("data_stale_days", sa.Double(), nullable=True)),
    ("satellite", sa.Column("orbit_stale_days", sa.Double(), nullable=True)),
    ("satellite", sa.Column("station_silent_hours", sa.Double(), nullable=True)),
    ("orbit", sa.Column("withdrawn_at", UtcDateTime(), nullable=True)),
    ("orbit", sa.Column("withdrawn_by", sa.String(length=32), nullable=True)),
    ("audit_event", sa.Column("reason", sa.String(length=2000), nullable=True)),
)
PLACE = ["satellite_id", "magnetometer_id"]


def upgrade() -> None:
    for table, column in ADDED:
        op.add_column(table, column)
    op.create_index("ix_session_satellite_id_magnetometer_id_data_until", "session", [*PLACE, "data_until"])
    op.create_index("ix_job_satellite_id_magnetometer_id_id", "job", [*PLACE, "id"])
    op.create_table(
        "session_monitoring",
        sa.Column("session_id", sa.String(length=32), nullable=False),
        sa.Column("parameter_set_id", sa.String(length=32), nullable=False),
        sa.Column("grade", sa.String(length=16), nullable=False),
        sa.Column("residual_rms_nt", sa.Double(), nullable=True),
        sa.Column("residual_ratio", sa.Double(), nullable=True),
        sa.Column("record", JsonColumn, nullable=False),
        sa.Column("judged_at", UtcDateTime(), nullable=False),
        sa.CheckConstraint(
            "grade IN ('agrees', 'watch', 'disagrees', 'too_short', 'not_judged')",
            name=op.f("ck_session_monitoring_grade"),
        ),
        sa.ForeignKeyConstraint(["session_id"], ["session.id"], name=op.f("fk_session_monitoring_session_id")),
        sa.PrimaryKeyConstraint("session_id", name=op.f("pk_session_monitoring")),
    )
    op.create_table(
        "attention_raised",
        *_entry_columns(),
        sa.Column("code", sa.String(length=32), nullable=False),
        sa.Column("severity", sa.String(length=8), nullable=False),
        sa.Column("raised_at", UtcDateTime(), nullable=False),
        *_entry_constraints("attention_raised"),
    )
    op.create_index("ix_attention_raised_satellite_id_magnetometer_id", "attention_raised", PLACE)
    op.create_table(
        "attention_acknowledgement",
        *_entry_columns(),
        sa.Column("about", sa.String(length=200), nullable=False),
        sa.Column("severity", sa.String(length=8), nullable=False),
        sa.Column("note", sa.String(length=2000), nullable=False),
        sa.Column("until", UtcDateTime(), nullable=True),
        sa.Column("at", UtcDateTime(), nullable=False),
        sa.Column("by", sa.String(length=32), nullable=True),
        *_entry_constraints("attention_acknowledgement"),
    )
    op.create_index("ix_attention_acknowledgement_satellite_id", "attention_acknowledgement", ["satellite_id"])
    op.create_table(
        "note",
        sa.Column("id", sa.String(length=32), nullable=False),
        sa.Column("kind", sa.String(length=16), nullable=False),
        sa.Column("subject", sa.String(length=130), nullable=False),
        sa.Column("satellite_id", sa.String(length=63), nullable=False),
        sa.Column("text", sa.String(length=4000), nullable=False),
        sa.Column("created_at", UtcDateTime(), nullable=False),
        sa.Column("created_by", sa.String(length=32), nullable=True),
        sa.CheckConstraint(
            "kind IN ('satellite', 'magnetometer', 'session', 'parameter_set')", name=op.f("ck_note_kind")
        ),
        sa.ForeignKeyConstraint(["satellite_id"], ["satellite.id"], name=op.f("fk_note_satellite_id")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_note")),
    )
    op.create_index("ix_note_satellite_id_id", "note", ["satellite_id", "id"])
    op.create_index("ix_note_kind_subject_id", "note", ["kind", "subject", "id"])


def _entry_columns() -> list[sa.Column[str]]:
    return [
        sa.Column("entry_id", sa.String(length=32), nullable=False),
        sa.Column("satellite_id", sa.String(length=63), nullable=False),
        sa.Column("magnetometer_id", sa.String(length=63), nullable=False),
    ]


def _entry_constraints(table: str) -> list[sa.Constraint]:
    return [
        sa.CheckConstraint("severity IN ('act', 'watch')", name=op.f(f"ck_{table}_severity")),
        sa.ForeignKeyConstraint(
            PLACE,
            ["magnetometer.satellite_id", "magnetometer.id"],
            name=op.f(f"fk_{table}_satellite_id_magnetometer_id"),
        ),
        sa.PrimaryKeyConstraint("entry_id", name=op.f(f"pk_{table}")),
    ]


def downgrade() -> None:
    for table in ("note", "attention_acknowledgement", "attention_raised", "session_monitoring"):
        op.drop_table(table)
    op.drop_index("ix_job_satellite_id_magnetometer_id_id", "job")
    op.drop_index("ix_session_satellite_id_magnetometer_id_data_until", "session")
    for table, column in reversed(ADDED):
        op.drop_column(table, column.name)
