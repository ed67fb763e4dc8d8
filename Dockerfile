# droguekit as a container: `docker build -t droguekit .`, or with a GPU `docker build --target cuda -t droguekit:cuda .`;
# docs/how-to/run-in-a-container.md says how to run it.
FROM debian:bookworm-slim AS install
# Extras of pyproject.toml; `train` brings torch.
ARG EXTRAS=mitsuba,exports,remote,video
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install -y --no-install-recommends python3 python3-venv \
    && rm -rf /var/lib/apt/lists/*
RUN python3 -m venv /opt/build && /opt/build/bin/pip install --no-cache-dir "build>=1.2,<2"
WORKDIR /source
COPY . .
RUN /opt/build/bin/python -m build --wheel --outdir /wheels
RUN python3 -m venv /opt/droguekit \
    && /opt/droguekit/bin/pip install --no-cache-dir --constraint constraints.txt "$(ls /wheels/*.whl)[${EXTRAS}]"

FROM debian:bookworm-slim AS runtime
# Mitsuba loads libatomic always, and LLVM for its fast variant.
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install -y --no-install-recommends ca-certificates libatomic1 libllvm15 python3 \
    && rm -rf /var/lib/apt/lists/*
COPY --from=install /opt/droguekit /opt/droguekit
# Compiled kernels and verdicts on LLVM libraries are kept in HOME, which any user of `--user` may write.
RUN useradd --uid 1000 --create-home --home-dir /var/cache/droguekit droguekit \
    && chmod 1777 /var/cache/droguekit
ENV HOME=/var/cache/droguekit PATH=/opt/droguekit/bin:$PATH
VOLUME /var/cache/droguekit
WORKDIR /data
USER 1000
ENTRYPOINT ["droguekit"]
CMD ["--help"]

# The driver's libraries, OptiX among them, come from the host: its NVIDIA container toolkit mounts what is named here.
FROM runtime AS cuda
ENV NVIDIA_VISIBLE_DEVICES=all NVIDIA_DRIVER_CAPABILITIES=compute,utility,graphics

# The last stage is what `docker build` makes without --target.
FROM runtime AS cpu
