# docker build -t cangauge . && docker run --rm --network host -v "$PWD:/data" cangauge run --help
# A tag can be moved: for an image that can be built again, give the base by its digest,
#   docker build --build-arg BASE=python@sha256:… -t cangauge .
# `docker buildx imagetools inspect python:3.13-slim` prints it.
ARG BASE=python:3.13-slim
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
