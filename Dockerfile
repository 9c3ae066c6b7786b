# docker build -t cangauge . && docker run --rm --network host -v "$PWD:/data" cangauge run --help
# The base by its digest (all platforms), since a tag can be moved. A newer one:
# `docker buildx imagetools inspect python:3.13-slim` prints its digest; put it here or in --build-arg BASE=….
ARG BASE=python:3.13.15-slim-trixie@sha256:7c61056e61ac89e852de05f3dc6fa51a6dd2181797bceed46aa725dd7cb2cd3b
FROM ${BASE} AS build
WORKDIR /src
# For the C core; the image that runs has no compiler.
RUN apt-get update && apt-get install -y --no-install-recommends gcc libc6-dev \
    && rm -rf /var/lib/apt/lists/*
COPY pyproject.toml hatch_build.py README.md LICENSE ./
COPY src src
COPY core core
COPY dbc dbc
COPY replay replay
RUN python -m venv /opt/cangauge && /opt/cangauge/bin/pip install --no-cache-dir '.[live,metrics,mf4]'

FROM ${BASE}
COPY --from=build /opt/cangauge /opt/cangauge
ENV PATH=/opt/cangauge/bin:$PATH \
    OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1 PYTHONUNBUFFERED=1
# CAN sockets of the host's network namespace need no privileges.
RUN useradd --create-home --uid 1000 cangauge
USER cangauge
WORKDIR /data
ENTRYPOINT ["cangauge"]
CMD ["--help"]
