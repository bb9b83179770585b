# syntax=docker/dockerfile:1

# One image for CPUs and for NVIDIA GPUs: see deploy/README.md.

FROM rust:1.95.0-slim-bookworm AS builder
# The program holds the list of its crates: `cargo audit bin fnsf` reads it.
RUN cargo install cargo-auditable --version 0.7.7 --locked
WORKDIR /build
# Targets that the manifest names must be there, whether they are built or not.
COPY Cargo.toml Cargo.lock build.rs ./
COPY proto proto
COPY benches benches
COPY examples examples
COPY console console
COPY clients/python/Cargo.toml clients/python/build.rs clients/python/
COPY clients/python/src clients/python/src
COPY src src
# Crates and what is compiled from them live in caches outside the layers: a change in src compiles src alone.
# The program is copied out, because a cache is not part of the image.
RUN --mount=type=cache,target=/usr/local/cargo/registry \
    --mount=type=cache,target=/build/target,sharing=locked \
    cargo auditable build --release --locked --bin fnsf && install -D --strip target/release/fnsf /out/fnsf


# Drivers are mounted in from the host and built against its C library: an older base would fail to load them, silently.
FROM ubuntu:24.04 AS runtime
ARG VERSION=0.1.0
ARG REVISION=unknown
LABEL org.opencontainers.image.title="fnsf" \
      org.opencontainers.image.description="Scene flow as a service: two lidar clouds in, the motion of every point out" \
      org.opencontainers.image.licenses="MIT" \
      org.opencontainers.image.version="${VERSION}" \
      org.opencontainers.image.revision="${REVISION}"

# The Vulkan loader, and the GL, EGL and X libraries that NVIDIA's Vulkan driver is linked with even where nothing is
# drawn. The dispatchers of GL and EGL are unpacked and not installed: their packages depend on Mesa and LLVM, 280 MB
# that nothing here uses. Versions are those of the pinned release: Ubuntu drops older ones, so pins would break rebuilds.
WORKDIR /tmp/dispatchers
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install -y --no-install-recommends \
        ca-certificates tini \
        libvulkan1 libglvnd0 libx11-6 libxcb1 libxext6 \
    && apt-get download libegl1 libgl1 libglx0 \
    && for package in ./*.deb; do dpkg-deb --extract "$package" /; done \
    && rm -rf ./*.deb /var/lib/apt/lists/* \
    && ldconfig

COPY deploy/image/nvidia_icd.json /etc/vulkan/icd.d/nvidia_icd.json
COPY --chmod=755 deploy/image/probe /usr/local/bin/probe
COPY --from=builder /out/fnsf /usr/local/bin/fnsf
RUN install -d -o 65532 -g 65532 /data

# This list replaces the container toolkit's own: without graphics no Vulkan driver is mounted, while nvidia-smi works.
ENV NVIDIA_DRIVER_CAPABILITIES=compute,utility,graphics
# A container's loopback is its own, so both ports listen on all addresses. The server then refuses to start without
# FNSF_SERVE_API_KEY (16 characters or more), or keys in a file.
ENV FNSF_SERVE_LISTEN=0.0.0.0:8080 \
    FNSF_SERVE_ADMIN_LISTEN=0.0.0.0:9090 \
    FNSF_SERVE_DATA_DIR=/data \
    FNSF_SERVE_LOG__FORMAT=json

USER 65532:65532
WORKDIR /data
VOLUME ["/data"]
EXPOSE 8080 9090
HEALTHCHECK --interval=10s --timeout=3s --start-period=30s CMD ["probe", "127.0.0.1", "9090", "/livez"]
STOPSIGNAL SIGTERM
ENTRYPOINT ["/usr/bin/tini", "--", "/usr/local/bin/fnsf"]
CMD ["serve"]
