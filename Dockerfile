# tools/build-image builds it with all labels, on a base by digest: see docs/containers.md.
# Without it, the base is the one that has this name today, or was loaded by it.
ARG BASE_IMAGE=python:3.11-slim-bookworm
# Written into datasets and descriptors: the image, and where its code is.
ARG IMAGE=hipsta_bids:1.0.0
ARG CODE_URL=

# Packages, which change less often than the program: nothing here depends on its code.
FROM ${BASE_IMAGE} AS packages
SHELL ["/bin/sh", "-euxc"]
# For a mirror: docker build --build-arg PIP_INDEX_URL=...
ARG PIP_INDEX_URL
ENV PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_NO_CACHE_DIR=1 PIP_NO_COMPILE=1 PIP_ROOT_USER_ACTION=ignore
WORKDIR /build
# The lock's only package without a wheel is built by the setuptools of the lock for development, so
# that nothing comes unchecked.
COPY requirements.lock requirements-dev.lock ./
RUN python -m venv /opt/hipsta_bids; \
    sed -n '/^setuptools==/,/# via/p' requirements-dev.lock > build.lock; \
    /opt/hipsta_bids/bin/pip install --require-hashes --no-deps -r build.lock; \
    /opt/hipsta_bids/bin/pip install --require-hashes --no-deps --no-build-isolation --use-pep517 -r requirements.lock

# What of them is never run; docs/containers.md has what stays. Libraries in *.libs were moved by their
# makers (auditwheel), and strip damages such files.
FROM packages AS slim
RUN command -v strip || { apt-get update; apt-get install --yes --no-install-recommends binutils; }; \
    /opt/hipsta_bids/bin/pip uninstall --yes imageio networkx pip plotly pygments setuptools tifffile xarray; \
    find /opt/hipsta_bids/bin -type f ! -name dask -delete; \
    sed -i '1s/$/ -I/' /opt/hipsta_bids/bin/dask; \
    cd /opt/hipsta_bids/lib/python3*/site-packages; \
    find . -type d \( -name test -o -name tests -o -name testdata \) -prune -exec rm -r {} +; \
    find . -type f \( -name '*.[achx]' -o -name '*.[ch]pp' -o -name '*.px[di]' -o -name '*.pyx' \) -delete; \
    # Stubs are for type checkers, but for one package that finds its functions by them.
    find . -path ./skimage -prune -o -type f -name '*.pyi' -exec rm {} +; \
    # Data to try things on, fonts that readers of PDF have, and those of styles that no figure has.
    find matplotlib/mpl-data/sample_data skimage/data sklearn/datasets statsmodels/datasets \
        -type f ! -name '*.py' ! -name '*.pyi' -delete; \
    rm -r matplotlib/mpl-data/fonts/afm matplotlib/mpl-data/fonts/pdfcorefonts; \
    rm matplotlib/mpl-data/fonts/ttf/cm* matplotlib/mpl-data/fonts/ttf/DejaVuSansMono* \
        matplotlib/mpl-data/fonts/ttf/DejaVuSerif*; \
    # Of fontTools matplotlib takes what puts the letters of a text into PDF; it works uncompiled.
    rm -r fontTools/t1Lib fontTools/diff fontTools/svgLib fontTools/mtiLib fontTools/merge \
        fontTools/voltLib fontTools/ufoLib fontTools/cu2qu fontTools/qu2cu fontTools/varLib/instancer; \
    find fontTools -name '*.so' -delete; \
    # Axes that nothing draws on, pictures of buttons, and helpers of matplotlib's own tests.
    rm -r mpl_toolkits/axes_grid1 mpl_toolkits/axisartist matplotlib/mpl-data/images matplotlib/testing; \
    rm -r PIL/_avif.* PIL/_imagingft.* pillow.libs/libavif-* pillow.libs/libfreetype-* pillow.libs/libharfbuzz-*; \
    # Of scikit-image contours, skeletons, and what they load; pages of dask's server.
    rm -r skimage/feature skimage/filters/rank skimage/future skimage/graph skimage/io skimage/metrics \
        skimage/registration skimage/restoration skimage/segmentation skimage/transform \
        distributed/http/static; \
    # Compilers, other databases, time series.
    rm -r numpy/distutils statsmodels/tsa \
        sqlalchemy/dialects/m*sql sqlalchemy/dialects/oracle sqlalchemy/dialects/postgresql sqlalchemy/testing; \
    find . -path '*.libs/*' -prune -o -type f -name '*.so*' -exec strip --strip-unneeded {} +; \
    python -m compileall -q -j 0 --invalidation-mode unchecked-hash /opt/hipsta_bids

# The program alone. Isolated (-I), since Apptainer hands on the environment: the caller's PYTHONPATH
# is for another Python.
FROM packages AS program
COPY . .
ARG IMAGE
ARG CODE_URL
RUN /opt/hipsta_bids/bin/python tools/make-descriptors --image "$IMAGE" --url "$CODE_URL"; \
    /opt/hipsta_bids/bin/pip install --no-deps --no-build-isolation --prefix /program .; \
    PYTHONPATH=$(echo /program/lib/python3*/site-packages) /opt/hipsta_bids/bin/pip check; \
    sed -i '1s/$/ -I/' /program/bin/hipsta-bids; \
    python -m compileall -q -j 0 --invalidation-mode unchecked-hash \
        -s /program -p /opt/hipsta_bids /program

FROM ${BASE_IMAGE}
ARG BASE_IMAGE
# The official base comes without the byte code of the standard library, and a read-only container
# could not keep it. Login shells set the path anew, and look in /usr/local/bin: platforms call by them.
RUN python -m compileall -q -j 0 -x 'site-packages|dist-packages|/test' \
        "$(python -c 'import sysconfig; print(sysconfig.get_path("stdlib"))')"; \
    ln -s /opt/hipsta_bids/bin/hipsta-bids /opt/hipsta_bids/bin/dask /usr/local/bin/
COPY --from=slim /opt/hipsta_bids /opt/hipsta_bids
COPY --from=program /program /opt/hipsta_bids
LABEL org.opencontainers.image.title="hipsta_bids" \
      org.opencontainers.image.description="BIDS App for hippocampal thickness, curvature and shape maps from subfield segmentations" \
      org.opencontainers.image.version="1.0.0" \
      org.opencontainers.image.authors="The hipsta_bids developers" \
      org.opencontainers.image.vendor="The hipsta_bids developers" \
      org.opencontainers.image.licenses="AGPL-3.0-or-later" \
      org.opencontainers.image.base.name="${BASE_IMAGE}"
ARG IMAGE
ARG CODE_URL
ENV LANG=C.UTF-8 \
    HIPSTA_BIDS_CONTAINER_TYPE=docker \
    HIPSTA_BIDS_CONTAINER_TAG=${IMAGE} \
    HIPSTA_BIDS_CODE_URL=${CODE_URL}
# The first user of most machines, by number since nothing is kept for them here: any other will do (-u).
USER 1000:1000
ENTRYPOINT ["hipsta-bids"]
