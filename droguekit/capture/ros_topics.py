"""Images of two topics of ROS 2, through rclpy."""

from __future__ import annotations

import threading
from collections import Counter, deque
from collections.abc import Iterator
from functools import partial
from typing import Any

from datasets_manifest.importers.ros_images import decode_image, message_stamp_ns
from droguekit.capture.stereo_source import CapturedImage, LoadedImage
from nav.realtime import Clock

_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_SPIN_S = 0.1
# Messages that wait in ROS, as in its profile of sensor data.
_DEPTH = 5


class RosTopics:
    """See `ImageStream`: the images of a left and a right topic."""

    def __init__(self, topics: tuple[str, str], timeout_s: float, clock: Clock) -> None:
        """Prepare to subscribe.

        Args:
            topics: of the left and the right images.
            timeout_s: longest wait for both to be published. [s]
            clock: for arrival times.

        Raises:
            ValueError: rclpy is missing.
        """
        try:
            import rclpy  # noqa: F401
        except ImportError as error:
            raise ValueError(
                f"--live: topics of ROS 2 need rclpy for this Python: {error}; source ROS's setup.bash, or "
                "pip install ros-rclpy ros-sensor-msgs ros-rmw-fastrtps-cpp"
            ) from error
        self.name = f"ros:{','.join(topics)}"
        self._topics, self._timeout_s, self._clock = topics, timeout_s, clock
        self._messages: deque[tuple[int, Any, float]] = deque()
        self._context: Any = None
        self._node: Any = None

    def open(self) -> None:
        """See `ImageStream`. Waits until both topics are published, to know what they carry."""
        import rclpy
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.signals import SignalHandlerOptions

        self._context = rclpy.Context()
        rclpy.init(context=self._context, signal_handler_options=SignalHandlerOptions.NO)
        try:
            self._node = rclpy.create_node("droguekit_navigate", context=self._context)
            self._executor = SingleThreadedExecutor(context=self._context)
            self._executor.add_node(self._node)
            for view, kind in enumerate(self._kinds()):
                self._subscribe(view, kind)
        except BaseException:
            self._close()
            raise

    def _kinds(self) -> list[str]:
        """Types of the two topics.

        Raises:
            ValueError: one is not published in time, or carries no images.
        """
        give_up_s = self._clock.now_s() + self._timeout_s
        while True:
            published = dict(self._node.get_topic_names_and_types())
            missing = [topic for topic in self._topics if topic not in published]
            if not missing:
                break
            if self._clock.now_s() > give_up_s:
                images = sorted(topic for topic, kinds in published.items() if set(kinds) & set(_TYPES))
                raise ValueError(
                    f"--live: nobody publishes {' and '.join(missing)}; topics of images: {', '.join(images) or 'none'}"
                )
            self._executor.spin_once(timeout_sec=_SPIN_S)
        for topic in self._topics:
            if published[topic][0] not in _TYPES:
                raise ValueError(f"--live: {topic} carries {published[topic][0]}, which is no image")
        return [published[topic][0] for topic in self._topics]

    def _subscribe(self, view: int, kind: str) -> None:
        from rclpy.qos import QoSProfile, ReliabilityPolicy
        from sensor_msgs.msg import CompressedImage, Image

        topic = self._topics[view]
        # Large images lose parts without repetition; asking for it where nobody offers it would get none.
        offered = {info.qos_profile.reliability for info in self._node.get_publishers_info_by_topic(topic)}
        is_reliable = offered == {ReliabilityPolicy.RELIABLE}
        reliability = ReliabilityPolicy.RELIABLE if is_reliable else ReliabilityPolicy.BEST_EFFORT

        def receive(message: Any) -> None:
            self._messages.append((view, message, self._clock.now_s()))

        message_type = Image if kind == _TYPES[0] else CompressedImage
        profile = QoSProfile(depth=_DEPTH, reliability=reliability)
        self._node.create_subscription(message_type, topic, receive, profile)

    def images(self, stop: threading.Event, left_out: Counter[str]) -> Iterator[CapturedImage]:
        """See `ImageStream`. Topics never end: RunningCamera notices that nothing comes."""
        try:
            while not stop.is_set():
                self._executor.spin_once(timeout_sec=_SPIN_S)
                while self._messages:
                    view, message, arrived_s = self._messages.popleft()
                    name = f"{self._topics[view]}: at {message_stamp_ns(message)} ns"
                    load = partial(_load, message, name)
                    yield CapturedImage(view, 1e-9 * message_stamp_ns(message), arrived_s, 0.0, load)
        finally:
            self._close()

    def _close(self) -> None:
        import rclpy

        if self._node is not None:
            self._node.destroy_node()
        rclpy.shutdown(context=self._context)


def _load(message: Any, name: str) -> LoadedImage:
    image = decode_image(message, name)
    return LoadedImage(image.pixels, image.mosaic)
