# docker build -t saga-fg .
# docker run --rm -v "$PWD/out:/data" saga-fg                                      the demo, to out/demo
# docker run --rm -p 7447:7447 saga-fg serve --listen 0.0.0.0:7447 --allow-remote  live tracking
# docker run --rm -v "$PWD:/data" saga-fg track file detections.csv --output tracks.csv
# With open3d, for LiDAR scans (0.9 GB more): docker build --build-arg OPEN3D=yes -t saga-fg .

FROM python:3.13-slim AS build
WORKDIR /source
COPY . .
RUN pip wheel --no-cache-dir --no-deps --wheel-dir /wheel .

FROM python:3.13-slim
ARG OPEN3D=no
RUN --mount=from=build,source=/source/.ci/small-install.txt,target=/tmp/small-install.txt \
    --mount=from=build,source=/wheel,target=/tmp/wheel \
    if [ "$OPEN3D" = yes ]; then \
        apt-get update && apt-get install --yes --no-install-recommends libgl1 libgomp1 libx11-6 \
        && rm -rf /var/lib/apt/lists/* && pip install --no-cache-dir /tmp/wheel/*.whl; \
    else \
        pip install --no-cache-dir -r /tmp/small-install.txt && pip install --no-cache-dir --no-deps /tmp/wheel/*.whl; \
    fi
RUN useradd --create-home --uid 1000 saga && mkdir /data && chown saga /data
USER saga
WORKDIR /data
ENV OPENBLAS_NUM_THREADS=1 MPLBACKEND=agg
EXPOSE 7447
ENTRYPOINT ["saga-fg"]
CMD ["demo", "--output", "demo"]
