# SPDX-License-Identifier: Apache-2.0
"""Train the network of onnx_perception.py on a dataset of ``chaserdock dataset``: ``python train.py
DATASET [--out landmarks.onnx]``.

A convolutional network of 0.3 million weights maps a crop of 64 x 64 pixels to the places of
landmarks. Needs jax and onnx.
"""

import argparse
import json
import time
from pathlib import Path

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import onnx
from chaserdock_models import rotations
from model_file import FILTERS, HIDDEN, LANDMARKS, network
from onnx_perception import SIDE, crop, find_region

from chaserdock.datasets.reading import read_dataset
from chaserdock.datasets.types import read_grey

BATCH, RATE = 64, 2e-3


def landmarks_of(points_m):
    """Return landmarks (n, 3) far from each other: each one is the vertex farthest from those
    before.
    """
    chosen = [points_m[np.argmax(np.linalg.norm(points_m, axis=1))]]
    for _ in range(LANDMARKS - 1):
        distance = np.min([np.linalg.norm(points_m - c, axis=1) for c in chosen], axis=0)
        chosen.append(points_m[np.argmax(distance)])
    return np.array(chosen)


def load(images, camera, landmarks):
    """Return the images, the regions found in them, and the pixels (n, k, 2) of the landmarks."""
    loaded = []
    for item in images:
        pixels = read_grey(item.path, camera)
        region = find_region(pixels)
        if region is not None:
            label = item.label
            at = camera.project(
                rotations.rotate(label.q_irf_trf_wxyz, landmarks) + label.position_irf_m
            )
            loaded.append((pixels, region, at))
    return loaded


def batch_of(samples, rng=None):
    """Return inputs (n, 1, SIDE, SIDE) and targets (n, 2 k) of samples, randomly turned, shifted
    and scaled with ``rng``.
    """
    inputs, targets = [], []
    for pixels, (centre, half), at in samples:
        turn = 0.0
        if rng is not None:
            turn = rng.uniform(-np.pi, np.pi)
            centre = centre + rng.uniform(-0.06, 0.06, 2) * half
            half = half * np.exp(rng.uniform(-0.08, 0.08))
        patch, to_image = crop(pixels, centre, half, turn)
        if rng is not None:
            patch = patch * np.float32(np.exp(rng.normal(0.0, 0.1)))
        inputs.append(patch[None])
        targets.append(((at - to_image[:, 2]) @ np.linalg.inv(to_image[:, :2]).T).ravel())
    return np.array(inputs), np.array(targets, dtype=np.float32)


def initial(rng):
    """Return the weights: filters (out, in, h, w) and biases, then two dense layers."""
    weights = []
    for side, inputs, outputs in FILTERS:
        scale = np.sqrt(2.0 / (inputs * side * side))
        weights.append((scale * rng.normal(size=(outputs, inputs, side, side)), np.zeros(outputs)))
    flat = FILTERS[-1][2] * (SIDE // 2 ** len(FILTERS)) ** 2
    for inputs, outputs in ((flat, HIDDEN), (HIDDEN, 2 * LANDMARKS)):
        weights.append(
            (np.sqrt(2.0 / inputs) * rng.normal(size=(inputs, outputs)), np.zeros(outputs))
        )
    return jax.tree.map(lambda w: jnp.asarray(w, dtype=jnp.float32), weights)


def places(weights, x):
    """Return the places (n, 2 k) of the landmarks in crops (n, 1, SIDE, SIDE), -1 to 1."""
    *filters, hidden, last = weights
    for w, b in filters:
        side = w.shape[2] // 2
        x = jax.lax.conv_general_dilated(
            x, w, (2, 2), ((side, side),) * 2, dimension_numbers=("NCHW", "OIHW", "NCHW")
        )
        x = jax.nn.relu(x + b[None, :, None, None])
    x = jax.nn.relu(x.reshape(len(x), -1) @ hidden[0] + hidden[1])
    return x @ last[0] + last[1]


@jax.jit
def step(weights, first, second, number, rate, x, y):
    """Return weights and moments after one step of Adam on the mean distance of the landmarks."""

    def loss(w):
        error = (places(w, x) - y).reshape(len(x), -1, 2)
        return jnp.mean(jnp.sqrt(jnp.sum(error**2, axis=-1) + 1e-6))

    value, slope = jax.value_and_grad(loss)(weights)
    first = jax.tree.map(lambda m, g: 0.9 * m + 0.1 * g, first, slope)
    second = jax.tree.map(lambda m, g: 0.999 * m + 0.001 * g**2, second, slope)

    def moved(w, m, v):
        return w - rate * (m / (1.0 - 0.9**number)) / (jnp.sqrt(v / (1.0 - 0.999**number)) + 1e-8)

    return jax.tree.map(moved, weights, first, second), first, second, value


def train(samples, epochs, rng, limit_s=np.inf):
    """Return trained weights; ends early, with a falling rate, after ``limit_s`` of CPU."""
    weights = initial(rng)
    first = second = jax.tree.map(jnp.zeros_like, weights)
    number, begin_s = 0, time.process_time()
    for epoch in range(epochs):
        order, losses = rng.permutation(len(samples)), []
        for start in range(0, len(order) - BATCH + 1, BATCH):
            x, y = batch_of([samples[k] for k in order[start : start + BATCH]], rng)
            number += 1
            share = max(
                (epoch + start / len(order)) / epochs, (time.process_time() - begin_s) / limit_s
            )
            rate = RATE * 0.5 * (1.0 + np.cos(np.pi * min(share, 1.0))) + 1e-5
            weights, first, second, value = step(weights, first, second, number, rate, x, y)
            losses.append(float(value))
            if share >= 1.0:
                return weights
        print(
            f"epoch {epoch + 1}: {np.mean(losses):.4f} of half a crop, "
            f"{time.process_time() - begin_s:.0f} s of CPU",
            flush=True,
        )
    return weights


def spread_of(found, samples, images, camera, landmarks):
    """Return standard deviations (6,) of poses, m per m and rad, from the median errors, and the
    RMS that 95 % of fits reach.
    """
    errors, rms = [], []
    for places_found, (_, (centre, half), _), item in zip(found, samples, images, strict=True):
        px = camera.undistort(places_found.reshape(-1, 2) * half + centre)
        done, turn, position = cv2.solvePnP(
            landmarks, px, camera.matrix(), None, flags=cv2.SOLVEPNP_SQPNP
        )
        if not done:
            continue
        q, label = rotations.exp(turn[:, 0]), item.label
        range_m = np.linalg.norm(label.position_irf_m)
        off = rotations.log(rotations.multiply(rotations.conjugate(q), label.q_irf_trf_wxyz))
        errors.append(np.concatenate([(position[:, 0] - label.position_irf_m) / range_m, off]))
        at = camera.project_ideal(rotations.rotate(q, landmarks) + position[:, 0])
        rms.append(np.sqrt(np.mean(np.sum((at - px) ** 2, axis=1))) / half)
    return 1.4826 * np.median(np.abs(errors), axis=0), float(np.quantile(rms, 0.95))


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--out", type=Path, default=Path("landmarks.onnx"))
    parser.add_argument("--epochs", type=int, default=40)
    parser.add_argument("--images", type=int, help="use the first training images only")
    parser.add_argument("--cpu-limit-s", type=float, default=np.inf)
    options = parser.parse_args()
    data, _ = read_dataset(options.dataset)
    if data.shape is None:
        parser.error(f"{options.dataset}: has no models folder")
    landmarks = landmarks_of(data.shape.points_m)
    samples = load(data.of_split("train")[: options.images], data.camera, landmarks)
    weights = train(samples, options.epochs, np.random.default_rng(1), options.cpu_limit_s)
    # The errors that the perception states: of training images, turned, so that validation images
    # stay unseen.
    checked = data.of_split("train")[:500]
    images = [i for i in checked if find_region(read_grey(i.path, data.camera)) is not None]
    fitted = load(images, data.camera, landmarks)
    found = np.array(places(weights, batch_of(fitted)[0]))
    sigma, most_rms = spread_of(found, fitted, images, data.camera, landmarks)
    facts = {
        "landmarks_m": json.dumps(landmarks.tolist()),
        "sigma": json.dumps(sigma.tolist()),
        "most_rms": str(most_rms),
    }
    onnx.save(network(weights, facts), str(options.out))
    print(
        f"{options.out}: {options.out.stat().st_size / 1e6:.1f} MB, sigma "
        f"{np.round(sigma, 4).tolist()}"
    )


if __name__ == "__main__":
    main()
