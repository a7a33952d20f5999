"""What Prometheus is told: requests and jobs as they pass, the queue as it stands."""

from __future__ import annotations

from typing import Final

from prometheus_client import Counter, Histogram

REQUEST_SECONDS: Final = Histogram(
    "magcal_request_seconds", "Time to answer a request, s.", ["method", "route", "status"]
)
JOB_SECONDS: Final = Histogram("magcal_job_seconds", "Time of one attempt at a job, s.", ["kind", "state"])
UPLOAD_BYTES: Final = Counter("magcal_upload_bytes", "Bytes of telemetry that were kept.")
