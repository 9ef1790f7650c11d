# syntax=docker/dockerfile:1
# docker build --target cpu -t rsjax .                docker run --rm -v "$PWD:/work" rsjax train debug
# docker build --target cuda -t rsjax:cuda .          docker run --rm --gpus all -v "$PWD:/work" rsjax:cuda train tiny
# A server inside needs --network host, since it listens on the loopback address (docs/serve.md, docs/play.md).

FROM python:3.12-slim-bookworm AS base
# OpenGL without a screen, for the simulators
RUN apt-get update \
    && apt-get install -y --no-install-recommends libegl1 libgl1 libgl1-mesa-dri libosmesa6 \
    && rm -rf /var/lib/apt/lists/*
RUN useradd --create-home --uid 1000 rsjax
ENV PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1 PYTHONUNBUFFERED=1
WORKDIR /src
COPY setup.cfg pyproject.toml README.md LICENSE requirements.txt requirements-nodeps.txt ./
COPY rsjax ./rsjax

FROM base AS cpu
RUN pip install -c requirements.txt ".[sim]" \
    && pip install --no-deps -r requirements-nodeps.txt
USER rsjax
WORKDIR /work
ENTRYPOINT ["rsjax"]
CMD ["--help"]

FROM base AS cuda
# The packages of jax[cuda13] hold CUDA; the host needs its driver and the NVIDIA Container Toolkit alone
RUN pip install -c requirements.txt ".[sim,cuda13]" \
    && pip install --no-deps -r requirements-nodeps.txt
ENV NVIDIA_VISIBLE_DEVICES=all NVIDIA_DRIVER_CAPABILITIES=compute,utility,graphics
USER rsjax
WORKDIR /work
ENTRYPOINT ["rsjax"]
CMD ["--help"]
