# syntax=docker/dockerfile:1
# The package with everything that its demo, its tests and its documentation need, on a CPU:
#   docker build -t sb3_dreamer_urlb .
#   docker run --rm -v "$PWD/demo_output:/home/user/sb3_dreamer_urlb/demo_output" sb3_dreamer_urlb
# For an NVIDIA GPU: docker build --build-arg TORCH_INDEX= (torch with CUDA, gigabytes more), and docker run --gpus all.
FROM python:3.11-slim-bookworm

# A renderer (OSMesa needs no device), a compiler for kernels of our own, make.
# hadolint ignore=DL3008
RUN apt-get update && apt-get install -y --no-install-recommends g++ libosmesa6 make && rm -rf /var/lib/apt/lists/*

ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu
ENV MUJOCO_GL=osmesa PIP_NO_CACHE_DIR=1

RUN useradd --create-home --uid 1000 user
USER 1000
WORKDIR /home/user/sb3_dreamer_urlb
COPY --chown=user . .
RUN make setup TORCH_INDEX="$TORCH_INDEX"

ENV PATH=/home/user/sb3_dreamer_urlb/.venv/bin:$PATH
CMD ["sb3-dreamer-urlb", "demo"]
