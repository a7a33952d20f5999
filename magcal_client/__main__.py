"""`python -m magcal_client`: the same as `magcal-push`."""

from magcal_client.push import run

run()
