# %% [markdown]
# # The same through a service
#
# `MAGCAL_URL` and `MAGCAL_KEY` name the service and a key with the scopes read, ingest and operate. Every call of the
# client is safe to repeat, and it repeats by itself what the network loses.

# %%
import os
from pathlib import Path

from app.client.blocking import Client

client = Client(os.environ.get("MAGCAL_URL", "http://127.0.0.1:8000"), os.environ["MAGCAL_KEY"])

# %%
client.create_satellite("example", name="Example")
client.create_magnetometer("example", "mgm-1", "nT", noise_nt=100.0)
orbits = client.send_orbits("example", Path(os.environ["MAGCAL_EXAMPLE_TLE"]).read_text(encoding="utf-8"))
print(len(orbits), "orbits")

# %%
telemetry = Path(os.environ["MAGCAL_EXAMPLE_TELEMETRY"]).read_bytes()
session = client.upload("example", "mgm-1", telemetry, "text/csv")
print("session", session["id"], "with", session["samples"], "samples")

# %%
found = client.calibrate([str(session["id"])], method="scalar")
print(found["verdict"])
print(found["parameters"])
