"""Looking after what is kept: audit it, make derived things again, move it to another database."""
