# Images that run lidarpool:
#   docker build --target cpu -t lidarpool .
#   docker build --target cuda -t lidarpool:cuda .    # run with --gpus all
#   docker run --rm -v "$PWD:/data" lidarpool run city.glb --out city
# The locked versions of all dependencies are installed, and the kernels are compiled while the image
# is built. The CUDA image needs only the NVIDIA driver and container toolkit of the host.
FROM debian:12-slim AS system
RUN apt-get update \
    && apt-get install -y --no-install-recommends ca-certificates git make python3 python3-venv \
        libegl1 libgl1 libgomp1 libidn2-0 libusb-1.0-0 \
    && rm -rf /var/lib/apt/lists/*

FROM system AS cpu
WORKDIR /opt/lidarpool
COPY requirements/run.txt requirements/
RUN python3 -m venv /opt/venv \
    && /opt/venv/bin/pip install --no-cache-dir --require-hashes -r requirements/run.txt
COPY pyproject.toml README.md LICENSE ./
COPY kernels kernels
COPY scheduler scheduler
COPY workflows workflows
RUN /opt/venv/bin/pip install --no-cache-dir --no-deps --no-build-isolation \
    ./kernels ./scheduler ./workflows/lidarsim ./workflows/lidarfiles ./workflows .
# Numba caches compiled kernels for the processor of the build. Other processors compile them once.
ENV PATH=/opt/venv/bin:$PATH NUMBA_CACHE_DIR=/var/cache/lidarpool
RUN mkdir -m 1777 /var/cache/lidarpool \
    && lidarpool scene city /tmp/city.glb \
    && lidarpool run /tmp/city.glb --out /tmp/smoke --cloud-only && rm -r /tmp/city.glb /tmp/smoke \
    && chmod -R a+rwX /var/cache/lidarpool
WORKDIR /data
ENTRYPOINT ["lidarpool"]
CMD ["doctor"]

FROM cpu AS cuda
RUN pip install --no-cache-dir "cupy-cuda12x[ctk]>=14.2"
