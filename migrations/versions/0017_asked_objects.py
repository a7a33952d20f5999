"""Requests outlive the satellite that they were for, under its catalogue number; marks of pulls go with theirs."""

import sqlalchemy as sa
from alembic import op

revision = "0017_asked_objects"
down_revision = "0016_integration"
branch_labels = None
depends_on = None

NUMBERS = """
UPDATE connector_request SET catalogue_number = (
    SELECT coalesce(nullif(ltrim(satellite.norad_id, '0'), ''), '0') FROM satellite
    WHERE satellite.id = connector_request.satellite_id
)
"""
MARKS = sa.table("connector_mark", sa.column("name"), sa.column("satellite_id"))
PLACES = {"yamcs": 1, "satnogs": 1, "hapi": 1, "orbits-of-the-past": 2}
"""First word of a mark's name, and where in it the satellite stands."""


def upgrade() -> None:
    with op.batch_alter_table("connector_request") as batch:
        batch.add_column(sa.Column("catalogue_number", sa.String(length=16), nullable=True))
        batch.alter_column("satellite_id", existing_type=sa.String(length=63), nullable=True)
    op.create_index(
        op.f("ix_connector_request_source_catalogue_number_asked_at"),
        "connector_request",
        ["source", "catalogue_number", "asked_at"],
    )
    with op.batch_alter_table("connector_mark") as batch:
        batch.add_column(sa.Column("satellite_id", sa.String(length=63), nullable=True))
        batch.create_foreign_key(op.f("fk_connector_mark_satellite_id"), "satellite", ["satellite_id"], ["id"])
    connection = op.get_bind()
    connection.execute(sa.text(NUMBERS))
    known = set(connection.execute(sa.text("SELECT id FROM satellite")).scalars())
    for name in connection.execute(sa.text("SELECT name FROM connector_mark")).scalars().all():
        words = name.split("/")
        if words[0] in PLACES:
            own = words[PLACES[words[0]]]
            found = MARKS.c.name == name
            connection.execute(
                sa.update(MARKS).where(found).values(satellite_id=own)
                if own in known
                else sa.delete(MARKS).where(found)
            )


def downgrade() -> None:
    with op.batch_alter_table("connector_mark") as batch:
        batch.drop_constraint(op.f("fk_connector_mark_satellite_id"), type_="foreignkey")
        batch.drop_column("satellite_id")
    op.get_bind().execute(sa.text("DELETE FROM connector_request WHERE satellite_id IS NULL"))
    op.drop_index(op.f("ix_connector_request_source_catalogue_number_asked_at"), "connector_request")
    with op.batch_alter_table("connector_request") as batch:
        batch.drop_column("catalogue_number")
        batch.alter_column("satellite_id", existing_type=sa.String(length=63), nullable=False)
