# SPDX-License-Identifier: Apache-2.0
"""From an image message to a sighting message: whatever is in the message, there is an answer."""

from __future__ import annotations

from typing import Any

import cv2
import msgspec
import numpy as np
import pytest
from chaserdock_agents.chaser.perception import Perception
from chaserdock_agents.chaser.sighting import BadImage, decode_image, look, prediction_from
from chaserdock_models import rotations
from chaserdock_models.targets import target_model
from chaserdock_protocol import codec
from chaserdock_protocol.messages import ExpectedPose, Image, Sighting
from chaserdock_protocol.scenario import Scenario, parse_scenario
from chaserdock_world.physics.simulation import BodyState
from chaserdock_world.rendering.cameras import Cameras
from hypothesis import given, settings
from hypothesis import strategies as st

WIDTH, HEIGHT = 640, 360


def scenario(jpeg_quality: int = 92) -> Scenario:
    return parse_scenario(
        {
            "name": "eye",
            "duration_s": 10.0,
            "navigation": {"grade": "exact"},
            "target": {"model": "servicer"},
            "camera": {
                "width_px": WIDTH,
                "height_px": HEIGHT,
                "effects": {"jpeg_quality": jpeg_quality},
            },
            "chasers": [{"position_m": [-1.5, 0.0, 0.0], "q_wxyz": [1.0, 0.0, 0.0, 0.0]}],
        },
        "test",
    )


@pytest.fixture(scope="module")
def perception() -> Perception:
    s = scenario()
    return Perception(s.camera_model(), target_model(s.target.model), "default")


def view(jpeg_quality: int = 92) -> tuple[Image, np.ndarray, np.ndarray]:
    """An image of the target, slightly turned, and where the target is in it."""
    s = scenario(jpeg_quality)
    still = np.zeros(3)
    q = rotations.exp([0.1, 0.25, -0.2])
    states = {
        "target": BodyState(np.zeros(3), still, q, still),
        "chaser/0": BodyState(np.array([-1.5, 0.05, -0.1]), still, rotations.IDENTITY, still),
    }
    image = Cameras(s).image(0, 0, 4, 266_666_666, states)
    position, attitude = s.camera_model().irf_pose_in_world(
        states["chaser/0"].position_m, states["chaser/0"].q_wxyz
    )
    q_irf = rotations.multiply(rotations.conjugate(attitude), q)
    return image, rotations.rotate_inverse(attitude, -np.asarray(position)), q_irf


def message(data: bytes, encoding: Any = "jpeg", **changes: Any) -> Image:
    values: dict[str, Any] = {"width_px": WIDTH, "height_px": HEIGHT} | changes
    return Image(tick=4, sim_time_ns=266_666_666, chaser=3, encoding=encoding, data=data, **values)


def jpeg(image: np.ndarray) -> bytes:
    return cv2.imencode(".jpg", image)[1].tobytes()


def checked(sighting: Sighting) -> Sighting:
    """Every result of a perception can be encoded."""
    return codec.decode(Sighting, codec.encode(sighting))


NOISE = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH), dtype=np.uint8)
JPEG = jpeg(NOISE)


def with_stated_size(data: bytes, height: int, width: int) -> bytes:
    """The JPEG with another size in its header than it has."""
    place = data.index(b"\xff\xc0") + 5
    return data[:place] + height.to_bytes(2, "big") + width.to_bytes(2, "big") + data[place + 4 :]


BAD: list[tuple[str, Image]] = [
    ("empty", message(b"")),
    ("empty mono8", message(b"", "mono8")),
    ("one byte", message(b"\xff")),
    ("text", message(b"this is no image" * 100)),
    ("zeros", message(bytes(10_000))),
    ("a JPEG's head alone", message(JPEG[:20])),
    ("a JPEG cut in the middle", message(JPEG[: len(JPEG) // 2])),
    ("a JPEG without its last byte", message(JPEG[:-1])),
    ("a JPEG of another size", message(jpeg(NOISE[:-8]))),
    ("a JPEG on its side", message(jpeg(NOISE.T))),
    ("a JPEG, stated as smaller", message(JPEG, height_px=HEIGHT - 1)),
    (
        "a JPEG that claims to be taller than it is",
        message(with_stated_size(JPEG, HEIGHT + 200, WIDTH)),
    ),
    ("a JPEG that claims to be huge", message(with_stated_size(JPEG, 65_500, 65_500))),
    (
        "a size that is right in itself and not the camera's",
        message(jpeg(NOISE[:-8]), height_px=HEIGHT - 8),
    ),
    ("mono8 a byte short", message(NOISE.tobytes()[:-1], "mono8")),
    ("mono8 a byte long", message(NOISE.tobytes() + b"\x00", "mono8")),
    (
        "mono8 of another camera",
        message(NOISE.tobytes(), "mono8", width_px=HEIGHT, height_px=WIDTH),
    ),
    ("a JPEG as mono8", message(JPEG, "mono8")),
    ("raw numbers as JPEG", message(NOISE.tobytes())),
    ("a PNG as JPEG", message(cv2.imencode(".png", NOISE)[1].tobytes())),
]


@pytest.mark.parametrize(("what", "image"), BAD, ids=[b[0] for b in BAD])
def test_bad_image_is_reported_and_gives_no_solution(
    perception: Perception, what: str, image: Image
) -> None:
    sighting = checked(look(perception, image, None))
    assert sighting.status == "bad_image"
    assert sighting.solutions == ()
    assert sighting.marker_ids == ()
    assert sighting.corners_px == ()
    assert sighting.detail
    assert "\n" not in sighting.detail
    assert (sighting.chaser, sighting.tick, sighting.sim_time_ns) == (3, 4, 266_666_666)


@given(st.data())
@settings(derandomize=True, deadline=None, max_examples=40)
def test_damaged_jpegs_never_raise_anything_else(data: st.DataObject) -> None:
    damaged = bytearray(jpeg(NOISE[:64, :64]))
    for _ in range(data.draw(st.integers(1, 5))):
        damaged[data.draw(st.integers(0, len(damaged) - 1))] = data.draw(st.integers(0, 255))
    try:
        image = decode_image(message(bytes(damaged), width_px=64, height_px=64))
    except BadImage:
        return
    assert image.shape == (64, 64)
    assert image.dtype == np.uint8


@pytest.mark.parametrize("encoding", ["jpeg", "mono8"])
@pytest.mark.parametrize("grey", [0, 128, 255])
def test_an_even_image_holds_nothing(perception: Perception, encoding: str, grey: int) -> None:
    image = np.full((HEIGHT, WIDTH), grey, dtype=np.uint8)
    data = jpeg(image) if encoding == "jpeg" else image.tobytes()
    sighting = checked(look(perception, message(data, encoding), None))
    assert sighting.status == "nothing"
    assert sighting.solutions == ()
    assert sighting.rejected_ids == ()
    assert sighting.detail == ""


def test_noise_holds_nothing(perception: Perception) -> None:
    assert look(perception, message(NOISE.tobytes(), "mono8"), None).status == "nothing"


@pytest.mark.parametrize("excess", [-1, 1, 640])
def test_mono8_image_has_one_byte_for_each_pixel(excess: int) -> None:
    data = NOISE.tobytes() + bytes(max(excess, 0))
    with pytest.raises(BadImage, match=rf"^{NOISE.size + excess} bytes; a mono8 image"):
        decode_image(message(data[: NOISE.size + excess], "mono8"))


def test_images_are_decoded_row_by_row() -> None:
    np.testing.assert_array_equal(decode_image(message(NOISE.tobytes(), "mono8")), NOISE)
    smooth = cv2.GaussianBlur(NOISE, (0, 0), 8.0)
    np.testing.assert_allclose(
        decode_image(message(jpeg(smooth))).astype(int), smooth.astype(int), atol=6
    )


@pytest.mark.parametrize("jpeg_quality", [0, 92])
def test_the_target_is_seen_where_it_is(perception: Perception, jpeg_quality: int) -> None:
    image, position, attitude = view(jpeg_quality)
    assert image.encoding == ("jpeg" if jpeg_quality else "mono8")
    sighting = checked(look(perception, image, None))
    assert sighting.status == "seen"
    assert (sighting.chaser, sighting.tick, sighting.sim_time_ns) == (0, 4, 266_666_666)
    best = sighting.solutions[0]
    assert np.linalg.norm(np.subtract(best.position_m, position)) < 0.005
    assert rotations.angle_between(np.array(best.q_wxyz), attitude) < np.radians(0.5)
    assert len(sighting.corners_px) == 8 * len(sighting.marker_ids)
    # Each used marker's corners lie in the image, u first.
    corners = np.reshape(sighting.corners_px, (-1, 2))
    assert np.all(corners >= -0.5)
    assert np.all(corners <= [WIDTH - 0.5, HEIGHT - 0.5])
    covariance = np.reshape(best.covariance, (6, 6))
    np.testing.assert_allclose(covariance, covariance.T, rtol=1e-9, atol=0)
    assert np.linalg.eigvalsh(covariance)[0] > 0.0


def test_where_it_looked_before_changes_nothing_but_the_time_it_takes(
    perception: Perception,
) -> None:
    image, position, attitude = view()
    blind = look(perception, image, None)
    for predicted in (
        prediction_from(blind),
        (position + 0.3, attitude),  # wrong
        (np.array([0.0, 0.0, -5.0]), attitude),  # behind the camera
        (np.array([100.0, 0.0, 1.0]), attitude),  # out of the image
    ):
        guided = look(perception, image, predicted)
        assert guided.status == "seen"
        a, b = guided.solutions[0], blind.solutions[0]
        assert np.linalg.norm(np.subtract(a.position_m, b.position_m)) < 0.002
        assert rotations.angle_between(np.array(a.q_wxyz), np.array(b.q_wxyz)) < np.radians(0.2)


def test_equal_images_give_equal_sightings(perception: Perception) -> None:
    image, _, _ = view()
    again, _, _ = view()
    assert image == again
    assert look(perception, image, None) == look(perception, again, None)


def test_a_prediction_comes_from_the_best_solution_if_there_is_one(perception: Perception) -> None:
    image, _, _ = view()
    seen = look(perception, image, None)
    predicted = prediction_from(seen)
    assert predicted is not None
    np.testing.assert_array_equal(predicted[0], seen.solutions[0].position_m)
    np.testing.assert_array_equal(predicted[1], seen.solutions[0].q_wxyz)
    assert prediction_from(None) is None
    unseen = msgspec.structs.replace(seen, solutions=(), status="nothing")
    assert prediction_from(unseen) is None
    expected = ExpectedPose(
        sim_time_ns=10**9, position_m=(0.0, 0.1, 2.0), q_wxyz=(0.0, 1.0, 0.0, 0.0)
    )
    for last, position_m in ((seen, seen.solutions[0].position_m), (unseen, expected.position_m)):
        predicted = prediction_from(last, expected, 10**9)
        assert predicted is not None
        np.testing.assert_array_equal(predicted[0], position_m)
    assert prediction_from(unseen, expected, 10**9 + 4 * 10**8) is None  # too old
