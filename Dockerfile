# SPDX-License-Identifier: Apache-2.0
# chaserdock in a container: one image for all processes of a mission. See compose.yaml and docs/deployment.md.
FROM python:3.11-slim AS wheel
COPY docker/build-requirements.txt /src/docker/
RUN pip install --no-cache-dir --require-hashes -r /src/docker/build-requirements.txt
COPY pyproject.toml README.md LICENSE build_hook.py /src/
COPY scenarios /src/scenarios
COPY chaserdock /src/chaserdock
COPY protocol /src/protocol
COPY world /src/world
COPY agents /src/agents
COPY controller /src/controller
RUN pip wheel --no-deps --no-build-isolation --wheel-dir /wheels /src

FROM python:3.11-slim AS image
ENV PYTHONUNBUFFERED=1 HOME=/tmp \
    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 MKL_NUM_THREADS=1
# What changes rarely comes first. Volumes take over the owner and mode of the folder that they are mounted on.
RUN useradd --uid 10001 --no-create-home --home-dir /tmp chaserdock \
    && mkdir -p /keys /runs /scenarios \
    && for name in router world controller standby mapper recorder operator analysis viewer bridge \
         $(seq -f chaser-%g 0 63); do mkdir /keys/$name; done \
    && chmod -R 1777 /keys
COPY requirements.txt docker/mujoco-requirements.txt docker/slim.py /opt/chaserdock/
RUN pip install --no-cache-dir --require-hashes -r /opt/chaserdock/requirements.txt \
    && pip install --no-cache-dir --no-deps --require-hashes -r /opt/chaserdock/mujoco-requirements.txt \
    && python /opt/chaserdock/slim.py
COPY --from=wheel /wheels /opt/chaserdock/wheels
RUN pip install --no-cache-dir --no-index --no-deps /opt/chaserdock/wheels/*.whl
COPY docker/as-owner docker/healthy /usr/local/bin/
USER chaserdock
WORKDIR /tmp
ENTRYPOINT ["python", "-m", "chaserdock.launch.container"]
HEALTHCHECK --interval=5s --timeout=60s --start-period=60s --retries=3 CMD ["healthy"]

# The same image, once it has flown a mission: on MuJoCo where PyBullet has no wheel. Compose builds the stage before, whose mission follows.
FROM image
RUN engine=$([ "$(uname -m)" = x86_64 ] && echo pybullet || echo mujoco) \
    && chaserdock run two-chaser-tracking --quiet --out /tmp/warm --set duration_s=6.0 --set settling_s=4.0 \
      --set world.engine=$engine \
      --set camera.width_px=640 --set camera.height_px=480 \
      --set success.steady_position_rms_m=0.2 --set success.steady_orientation_rms_deg=10.0 \
    && rm -rf /tmp/warm
