"""From samples with their reference to an estimate: one module a step, each is handed the product of the one before."""
