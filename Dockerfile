# loam_gtsam in a container: docker build -t loam_gtsam . && docker run --rm --user "$(id -u)" -v "$PWD:/data" loam_gtsam demo
FROM python:3.12-slim AS build
COPY . /source
RUN pip wheel --no-cache-dir --no-deps --wheel-dir /wheels /source

FROM python:3.12-slim
COPY --from=build /wheels /wheels
RUN pip install --no-cache-dir "$(ls /wheels/*.whl)[plot]" && rm -r /wheels
RUN useradd --create-home mapper && install --directory --mode 1777 /data
ENV MPLCONFIGDIR=/tmp/matplotlib
USER mapper
WORKDIR /data
ENTRYPOINT ["loam-gtsam"]
CMD ["--help"]
