"""Topics of ROS 2: with rclpy where it is installed, and one line where it is not."""

from __future__ import annotations

import array
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from droguekit.capture.ros_topics import RosTopics
from droguekit.capture.stereo_source import RunningCamera
from droguekit.cli.main import WRONG_INPUT, run
from nav.realtime import MonotonicClock
from tests.support.live_streams import write_calibration

TOPICS = ("/stereo/left/image_raw", "/stereo/right/image_raw")
PATIENCE_S = 30.0
RNG = np.random.default_rng(3)
VIEWS = [RNG.integers(0, 256, (48, 64, 3), dtype=np.uint8) for _ in range(2)]


def test_without_rclpy_one_line_says_how_to_get_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "rclpy", None)
    calibration = write_calibration(tmp_path / "stereo.yaml", 64, 48, 100.0, 0.12)
    options = ["--live", f"ros:{','.join(TOPICS)}", "--calibration", str(calibration), "--out", str(tmp_path / "out")]
    assert run(["navigate", *options]) == WRONG_INPUT
    (error,) = capsys.readouterr().err.splitlines()
    assert "topics of ROS 2 need rclpy for this Python" in error and "source ROS's setup.bash" in error


@contextmanager
def publishers(kind: str) -> Iterator[list[Any]]:
    """Publishers of both topics, in a context of their own."""
    rclpy = pytest.importorskip("rclpy")
    messages = pytest.importorskip("sensor_msgs.msg")
    context = rclpy.Context()
    rclpy.init(context=context)
    node = rclpy.create_node("camera", context=context)
    try:
        yield [node.create_publisher(getattr(messages, kind), topic, 5) for topic in TOPICS]
    finally:
        node.destroy_node()
        rclpy.shutdown(context=context)


def message(kind: str, image: np.ndarray, stamp_ns: int) -> Any:
    made = getattr(pytest.importorskip("sensor_msgs.msg"), kind)()
    made.header.stamp.sec, made.header.stamp.nanosec = divmod(stamp_ns, 10**9)
    if kind == "CompressedImage":
        made.format = "png"
        made.data = array.array("B", cv2.imencode(".png", image[:, :, ::-1])[1].tobytes())
        return made
    made.height, made.width = image.shape[:2]
    made.encoding, made.step = "rgb8", 3 * image.shape[1]
    made.data = array.array("B", image.tobytes())
    return made


@pytest.mark.parametrize("kind", ["Image", "CompressedImage"])
def test_pairs_of_topics_arrive_bit_for_bit_with_their_stamps(kind: str) -> None:
    with publishers(kind) as (left, right):
        camera = RunningCamera(
            "ros", [RosTopics(TOPICS, PATIENCE_S, MonotonicClock())], MonotonicClock(), PATIENCE_S, 0
        )
        stamps_ns = [10**18, 10**18 + 40_000_000, 10**18 + 80_000_000]

        def publish(index: int) -> None:
            for publisher, image in ((right, VIEWS[1]), (left, VIEWS[0])):
                publisher.publish(message(kind, np.roll(image, index, 0), stamps_ns[index]))

        def publish_first() -> None:
            # Messages before the subscription are lost.
            while min(publisher.get_subscription_count() for publisher in (left, right)) == 0 and not done.wait(0.01):
                pass
            publish(0)

        done, pairs = threading.Event(), camera.pairs()
        sender = threading.Thread(target=publish_first)
        sender.start()
        try:
            first = next(pairs)
        finally:
            done.set()
            sender.join()
        found = [first]
        for index in (1, 2):
            publish(index)
            found.append(next(pairs))
        pairs.close()
    for index, pair in enumerate(found):
        assert pair.time_s == 1e-9 * stamps_ns[index]
        np.testing.assert_array_equal(pair.left.pixels, np.roll(VIEWS[0], index, 0))
        np.testing.assert_array_equal(pair.right.pixels, np.roll(VIEWS[1], index, 0))


def test_a_topic_that_nobody_publishes_is_named_with_those_that_are() -> None:
    with publishers("Image"):
        topics = ("/stereo/left/image_raw", "/stereo/right/image")
        camera = RunningCamera("ros", [RosTopics(topics, 1.0, MonotonicClock())], MonotonicClock(), PATIENCE_S, 0)
        with pytest.raises(ValueError, match="nobody publishes /stereo/right/image; topics of images: /stereo/left"):
            next(camera.pairs())
