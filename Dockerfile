# magcal: one image for both roles: `serve` (the default) and `worker`.
FROM python:3.11-slim AS build

# The processor that kernels are compiled for: any x86-64 of the last ten years. On Arm: --build-arg KERNEL_CPU=generic
ARG KERNEL_CPU=x86-64-v3
WORKDIR /src
COPY requirements/run.txt ./
RUN python -m venv /opt/magcal \
    && /opt/magcal/bin/pip install --no-cache-dir --disable-pip-version-check --require-hashes -r run.txt
COPY pyproject.toml README.md ./
COPY magcal_core magcal_core
COPY migrations migrations
COPY magcal_client magcal_client
COPY app app
RUN /opt/magcal/bin/pip install --no-cache-dir --disable-pip-version-check --no-deps . \
    && env NUMBA_CACHE_DIR=/opt/magcal/kernels NUMBA_CPU_NAME="$KERNEL_CPU" NUMBA_CPU_FEATURES= \
        /opt/magcal/bin/python -m magcal_core.compile_kernels

FROM python:3.11-slim

ARG KERNEL_CPU=x86-64-v3
RUN useradd --system --uid 10001 --no-log-init --home-dir /var/lib/magcal --shell /usr/sbin/nologin magcal \
    && install --directory --owner magcal --group magcal /var/lib/magcal /var/cache/magcal
COPY --from=build /opt/magcal /opt/magcal
ENV PATH=/opt/magcal/bin:$PATH \
    PYTHONUNBUFFERED=1 \
    NUMBA_CACHE_DIR=/var/cache/magcal \
    NUMBA_CPU_NAME=$KERNEL_CPU \
    NUMBA_CPU_FEATURES= \
    MAGCAL_DATA_DIR=/var/lib/magcal \
    MAGCAL_HOST=0.0.0.0 \
    MAGCAL_PORT=8000
USER 10001
WORKDIR /var/lib/magcal
VOLUME /var/lib/magcal
EXPOSE 8000
HEALTHCHECK --interval=15s --timeout=5s --start-period=60s --retries=4 \
    CMD ["python", "-c", "import os, urllib.request as u; u.urlopen(f'http://127.0.0.1:{os.environ[\"MAGCAL_PORT\"]}/healthz', timeout=4)"]
ENTRYPOINT ["magcal"]
CMD ["serve"]
