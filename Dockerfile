# See docs/containers.md for how to build, run and test it.
ARG BASE_IMAGE=python:3.11-slim-bookworm

FROM ${BASE_IMAGE} AS build
SHELL ["/bin/sh", "-euxc"]
# For a mirror: docker build --build-arg PIP_INDEX_URL=...
ARG PIP_INDEX_URL
ENV PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_NO_CACHE_DIR=1 PIP_NO_COMPILE=1 PIP_ROOT_USER_ACTION=ignore
WORKDIR /build

# Packages first: they change less often than the program. The lock's only package without a wheel is
# built by the setuptools of the lock for development, so that nothing comes unchecked.
COPY requirements.lock requirements-dev.lock ./
RUN python -m venv /opt/hipsta_bids; \
    sed -n '/^setuptools==/,/# via/p' requirements-dev.lock > build.lock; \
    /opt/hipsta_bids/bin/pip install --require-hashes -r build.lock; \
    /opt/hipsta_bids/bin/pip install --require-hashes --no-build-isolation --use-pep517 -r requirements.lock; \
    find /opt/hipsta_bids -type d -name tests -prune -exec rm -r {} +

COPY . .
# Plotly (64 MB) is required by LaPy's metadata, but imported by lapy.plot alone, which nothing here uses.
# Isolated (-I), since Apptainer hands on the environment: the caller's PYTHONPATH is for another Python.
RUN /opt/hipsta_bids/bin/pip install --no-deps --no-build-isolation .; \
    /opt/hipsta_bids/bin/pip check; \
    /opt/hipsta_bids/bin/pip uninstall --yes plotly setuptools pip; \
    sed -i '1s/$/ -I/' /opt/hipsta_bids/bin/hipsta-bids; \
    python -m compileall -q -j 0 --invalidation-mode unchecked-hash /opt/hipsta_bids

FROM ${BASE_IMAGE}
ARG BASE_IMAGE
LABEL org.opencontainers.image.title="hipsta_bids" \
      org.opencontainers.image.description="BIDS App for hippocampal thickness, curvature and shape maps from subfield segmentations" \
      org.opencontainers.image.version="0.1.0" \
      org.opencontainers.image.authors="The hipsta_bids developers" \
      org.opencontainers.image.licenses="AGPL-3.0-or-later" \
      org.opencontainers.image.base.name="${BASE_IMAGE}"
# The official base comes without the byte code of the standard library, and a read-only container
# could not keep it.
RUN python -m compileall -q -j 0 -x 'site-packages|dist-packages|/test' \
    "$(python -c 'import sysconfig; print(sysconfig.get_path("stdlib"))')"
COPY --from=build /opt/hipsta_bids /opt/hipsta_bids
# Where login shells look too, which set the path anew: platforms call by them.
RUN ln -s /opt/hipsta_bids/bin/hipsta-bids /usr/local/bin/
# Written into datasets, as GeneratedBy: the image, and where its code is.
ARG CODE_URL
ENV LANG=C.UTF-8 \
    HIPSTA_BIDS_CONTAINER_TYPE=docker \
    HIPSTA_BIDS_CONTAINER_TAG=hipsta_bids:0.1.0 \
    HIPSTA_BIDS_CODE_URL=${CODE_URL}
ENTRYPOINT ["hipsta-bids"]
