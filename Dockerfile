# surgbench on the CPU, for a user without rights. How to build and use it: docs/container.md
ARG PYTHON=3.11.14-slim-bookworm

FROM python:${PYTHON} AS build
# Where pip also looks, for PyTorch's CPU build: the address that PyTorch's site names for it. Without, pip brings CUDA.
ARG PIP_EXTRA_INDEX_URL=
# Extras, with commas between them.
ARG EXTRAS=video
WORKDIR /source
COPY . .
RUN python -m venv /opt/surgbench \
    && /opt/surgbench/bin/pip install --no-cache-dir --disable-pip-version-check -c constraints.txt ".[${EXTRAS}]"

FROM python:${PYTHON}
# Names of the parts that need system libraries of their own, as tools/system-libraries.sh knows them: meshes.
ARG LIBRARIES=
COPY tools/system-libraries.sh /tmp/system-libraries.sh
# Split into words on purpose: each is a part.
# hadolint ignore=SC2086
RUN sh /tmp/system-libraries.sh ${LIBRARIES} \
    && rm -rf /tmp/system-libraries.sh /var/lib/apt/lists/* \
    && useradd --create-home --uid 1000 surgbench \
    && install -d -o surgbench -g surgbench /work
COPY --from=build /opt/surgbench /opt/surgbench
ENV PATH=/opt/surgbench/bin:${PATH}
USER 1000
WORKDIR /work
ENTRYPOINT ["surgbench"]
CMD ["--help"]
