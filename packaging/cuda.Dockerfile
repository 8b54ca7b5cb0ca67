# gvtools on an NVIDIA card, with the CUDA toolkit that gsplat compiles its kernels with. From the
# repository's root:
#
#   docker build -f packaging/cuda.Dockerfile -t gvtools:cuda .
#   docker run --rm --gpus all -v "$PWD:/data" --user "$(id -u):$(id -g)" gvtools:cuda \
#     demo --device cuda --out /data/demo
ARG BASE=nvidia/cuda:13.0.2-devel-ubuntu24.04

FROM ${BASE} AS build
ARG TORCH_INDEX=https://download.pytorch.org/whl/cu130
ARG EXTRAS=web,export,film,phones,cuda
ENV PIP_DISABLE_PIP_VERSION_CHECK=1
RUN apt-get update \
    && apt-get install -y --no-install-recommends python3 python3-venv \
    && rm -rf /var/lib/apt/lists/*
WORKDIR /src
COPY constraints.txt ./
# Of torch's index nothing but torch: all else comes from PyPI, with the same versions everywhere.
RUN python3 -m venv /opt/gvtools \
    && /opt/gvtools/bin/pip install --no-cache-dir --no-deps -c constraints.txt \
        --index-url "${TORCH_INDEX}" torch
COPY setup.cfg pyproject.toml README.md LICENSE ./
COPY gvtools ./gvtools
COPY viz ./viz
COPY pipelines ./pipelines
COPY data_specs ./data_specs
RUN /opt/gvtools/bin/pip install --no-cache-dir -c constraints.txt ".[${EXTRAS}]"

FROM ${BASE}
# What Open3D's wheel links (gvtools/system_libraries.py), Python, and what gsplat compiles with.
RUN apt-get update \
    && apt-get install -y --no-install-recommends \
        libegl1 \
        libgl1 \
        libgomp1 \
        libidn2-0 \
        libudev1 \
        libusb-1.0-0 \
        libx11-6 \
        ninja-build \
        python3 \
        python3-dev \
    && rm -rf /var/lib/apt/lists/*
# Compiled kernels are kept where every user may write, as --user makes any of them the container's.
RUN useradd --create-home --uid 10001 gvtools \
    && install -d -m 1777 /var/cache/gvtools
ENV PATH=/opt/gvtools/bin:$PATH \
    NUMBA_CACHE_DIR=/var/cache/gvtools/numba \
    MPLCONFIGDIR=/var/cache/gvtools/matplotlib \
    XDG_CACHE_HOME=/var/cache/gvtools \
    TORCH_EXTENSIONS_DIR=/var/cache/gvtools/torch
COPY --from=build /opt/gvtools /opt/gvtools
USER 10001
WORKDIR /data
EXPOSE 8080
ENTRYPOINT ["gvtools"]
CMD ["--help"]
