"""Node `fragment_player`: replays bags of fragments, pairs and ground truth.

What it publishes was recorded: bytes go from the bag to DDS without being decoded. Order of
play: ground truth and the clock first, then the bags one after the other.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

from rclpy.duration import Duration
from rclpy.node import Node
from rosgraph_msgs.msg import Clock
from std_srvs.srv import Trigger

from nss_msgs.msg import Fragment as FragmentMessage
from nss_msgs.msg import FragmentPair as PairMessage
from nss_msgs.msg import PlaybackStatus
from nss_msgs.msg import PoseGraph as PoseGraphMessage
from nss_msgs.msg import RelativeTransform as RelativeTransformMessage
from nss_ros import topics
from nss_ros.bag_reader import BagReader, RawMessage, decode
from nss_ros.config import PlayerConfig
from nss_ros.errors import BagError
from nss_ros.fragment import FragmentId, FragmentPair
from nss_ros.messages import pair_from, pair_message, rosidl_family, time_message
from nss_ros.nodes.diagnostics import Health, publish_diagnostics
from nss_ros.nodes.parameters import declare_parameters, follow_parameters
from nss_ros.nodes.qos import publisher_qos, subscription_qos
from nss_ros.nodes.spin import Background, run_node

_PLAYED = {topics.FRAGMENTS.type, topics.FRAGMENT_PAIRS.type}
_CLOCK_PERIOD = 0.02
_POLL = 0.02


class FragmentPlayer(Node):
    """Replays bags at a rate, with pause, loop and back-pressure.

    Raises:
        BagError: a bag cannot be read, or holds no fragment.
    """

    def __init__(self) -> None:
        super().__init__("fragment_player")
        self._config = declare_parameters(self, PlayerConfig)
        follow_parameters(self, PlayerConfig, self._apply)
        self._contents = [_scan(Path(bag)) for bag in self._config.bags]
        if not self._contents:
            raise BagError("The player has no bag: set its parameter 'bags' to bag folders.")
        self._across = _pairs_across(self._contents) if self._config.pair_across_bags else []
        self._fragments_total = len({name for c in self._contents for name in c.fragments})
        self._pairs_total = len({p for c in self._contents for p in c.pairs} | set(self._across))
        self._fragments_published: set[str] = set()
        self._pairs_published: set[tuple[str, str]] = set()
        self._answered: set[tuple[str, str]] = set()
        self._state = PlaybackStatus.STATE_PLAYING
        self._stamp = min(content.start for content in self._contents)
        self._playing = threading.Event()
        if not self._config.start_paused:
            self._playing.set()
        self._create_interface()
        self.background = Background("play", self._play)
        self.background.start()

    def close(self) -> None:
        """Stop playing."""
        self._playing.set()
        self.background.stop()

    def _create_interface(self) -> None:
        graphs = sum(content.ground_truth for content in self._contents)
        self._ground_truth = self.create_publisher(
            PoseGraphMessage,
            topics.GROUND_TRUTH.name,
            publisher_qos(topics.GROUND_TRUTH, max(1, graphs)),
        )
        self._fragments = self.create_publisher(
            FragmentMessage,
            topics.FRAGMENTS.name,
            publisher_qos(topics.FRAGMENTS, self._fragments_total),
        )
        self._pairs = self.create_publisher(
            PairMessage,
            topics.FRAGMENT_PAIRS.name,
            publisher_qos(topics.FRAGMENT_PAIRS, max(1, self._pairs_total)),
        )
        self._status = self.create_publisher(
            PlaybackStatus, topics.PLAYBACK_STATUS.name, publisher_qos(topics.PLAYBACK_STATUS)
        )
        self._clock_publisher = self.create_publisher(
            Clock, topics.CLOCK.name, publisher_qos(topics.CLOCK)
        )
        self.create_subscription(
            RelativeTransformMessage,
            topics.RELATIVE_TRANSFORMS.name,
            self._on_answer,
            subscription_qos(topics.RELATIVE_TRANSFORMS),
        )
        self.create_service(Trigger, "~/pause", self._on_pause)
        self.create_service(Trigger, "~/resume", self._on_resume)
        publish_diagnostics(self, self._health)

    def _apply(self, config: PlayerConfig) -> None:
        self._config = config

    def _on_answer(self, message: RelativeTransformMessage) -> None:
        self._answered.add((message.source_id, message.target_id))

    def _on_pause(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._playing.clear()
        response.success, response.message = True, "Paused."
        return response

    def _on_resume(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._playing.set()
        response.success, response.message = True, "Playing."
        return response

    def _health(self) -> Health:
        values = {
            "fragments": f"{len(self._fragments_published)} / {self._fragments_total}",
            "pairs": f"{len(self._pairs_published)} / {self._pairs_total}",
            "pairs_answered": len(self._answered),
        }
        states = {0: "playing", 1: "paused", 2: "waiting for a consumer", 3: "finished"}
        return True, states[self._state], values

    def _play(self) -> None:
        self._publish_clock()
        self._publish_status(PlaybackStatus.STATE_PLAYING)
        self._publish_ground_truth()
        self._await_subscriber()
        while not self.background.stopping.is_set():
            for content in self._contents:
                self._play_bag(content)
            for pair in self._across:
                self._publish_pair(str(pair.source), str(pair.target), self._pair_message(pair))
            if not self._config.loop:
                break
        self._publish_clock()
        self._publish_status(PlaybackStatus.STATE_FINISHED)
        self.background.stopping.wait()

    def _play_bag(self, content: _Content) -> None:
        begin = content.start + round(self._config.start_offset * 1e9)
        self._stamp = content.start
        bag_time, wall_time = begin, time.monotonic()
        for message in BagReader(content.path).messages(_PLAYED):
            if self.background.stopping.is_set():
                return
            if not self._playing.is_set():
                self._pause()
                bag_time, wall_time = max(begin, self._stamp), time.monotonic()
            # Everything is latched, so what lies before the start offset is published too, at once.
            if self._config.rate > 0 and message.stamp > begin:
                self._sleep_until(message.stamp, bag_time, wall_time)
            self._stamp = max(self._stamp, message.stamp)
            self._publish(message)

    def _publish(self, message: RawMessage) -> None:
        self._publish_clock()
        if message.type == topics.FRAGMENTS.type:
            self._publish_fragment(message)
        else:
            pair = decode(message)
            self._publish_pair(pair.source_id, pair.target_id, bytes(message.data))

    def _publish_fragment(self, message: RawMessage) -> None:
        self._fragments.publish(bytes(message.data))
        # Do not run ahead of DDS: a reader that is full makes this wait.
        while not self._fragments.wait_for_all_acked(Duration(seconds=0.5)):
            if self.background.stopping.is_set():
                return
            self._publish_status(PlaybackStatus.STATE_WAITING)
        self._fragments_published.add(_fragment_id(message))
        self._publish_status(PlaybackStatus.STATE_PLAYING)

    def _publish_pair(self, source: str, target: str, message: bytes | PairMessage) -> None:
        self._await_answers()
        if self.background.stopping.is_set():
            return
        self._pairs.publish(message)
        self._pairs_published.add((source, target))
        self._publish_status(PlaybackStatus.STATE_PLAYING)

    def _pair_message(self, pair: FragmentPair) -> PairMessage:
        return pair_message(pair, self._stamp, rosidl_family())

    def _await_answers(self) -> None:
        """Hold back while too many pairs are open, if anybody answers pairs at all."""
        waiting = False
        while not self.background.stopping.is_set():
            limit = self._config.max_pending_pairs
            pending = len(self._pairs_published - self._answered)
            if limit == 0 or pending < limit:
                return
            if self.count_publishers(topics.RELATIVE_TRANSFORMS.name) == 0:
                return
            if not waiting:
                self._publish_status(PlaybackStatus.STATE_WAITING)
                waiting = True
            time.sleep(_POLL)

    def _await_subscriber(self) -> None:
        deadline = time.monotonic() + self._config.wait_for_subscribers
        while time.monotonic() < deadline and not self.background.stopping.is_set():
            if self._fragments.get_subscription_count() > 0:
                return
            time.sleep(_POLL)

    def _pause(self) -> None:
        self._publish_status(PlaybackStatus.STATE_PAUSED)
        while not self._playing.wait(_CLOCK_PERIOD):
            self._publish_clock()
            if self.background.stopping.is_set():
                return
        self._publish_status(PlaybackStatus.STATE_PLAYING)

    def _sleep_until(self, stamp: int, bag_time: int, wall_time: float) -> None:
        while self._playing.is_set() and self._config.rate > 0:
            elapsed = (time.monotonic() - wall_time) * self._config.rate
            now = bag_time + round(elapsed * 1e9)
            remaining = (stamp - now) / 1e9 / self._config.rate
            if remaining <= 0 or self.background.stopping.wait(min(remaining, _CLOCK_PERIOD)):
                return
            self._stamp = max(self._stamp, min(now, stamp))
            self._publish_clock()

    def _publish_ground_truth(self) -> None:
        for content in self._contents:
            for message in content.ground_truth_messages():
                self._ground_truth.publish(bytes(message.data))

    def _publish_clock(self) -> None:
        if self._config.publish_clock:
            self._clock_publisher.publish(Clock(clock=time_message(self._stamp, rosidl_family())))

    def _publish_status(self, state: int) -> None:
        self._state = state
        status = PlaybackStatus(
            state=state,
            bags=[str(content.path) for content in self._contents],
            fragments_total=self._fragments_total,
            fragments_published=len(self._fragments_published),
            pairs_total=self._pairs_total,
            pairs_published=len(self._pairs_published),
        )
        status.header.stamp = time_message(self._stamp, rosidl_family())
        self._status.publish(status)


class _Content:
    """What a bag holds, without its points."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.start = 2**63 - 1
        self.fragments: list[str] = []
        self.pairs: list[FragmentPair] = []
        self.ground_truth = 0
        for message in BagReader(path).messages(_PLAYED | {topics.GROUND_TRUTH.type}):
            self.start = min(self.start, message.stamp)
            if message.type == topics.FRAGMENTS.type:
                self.fragments.append(_fragment_id(message))
            elif message.type == topics.FRAGMENT_PAIRS.type:
                self.pairs.append(pair_from(decode(message)))
            else:
                self.ground_truth += _is_ground_truth(message)

    def ground_truth_messages(self) -> Iterator[RawMessage]:
        messages = BagReader(self.path).messages({topics.GROUND_TRUTH.type})
        return (message for message in messages if _is_ground_truth(message))


def _scan(path: Path) -> _Content:
    content = _Content(path)
    if not content.fragments:
        raise BagError(f"{path} holds no fragment: make a bag with 'nss import' or 'nss simulate'.")
    return content


def _pairs_across(contents: list[_Content]) -> list[FragmentPair]:
    """All pairs of one area between bags that no bag asks for itself; none where no bag asks."""
    asked = {pair for content in contents for pair in content.pairs}
    if not asked:
        return []  # then the registration node proposes pairs
    ids = [sorted({FragmentId.parse(name) for name in content.fragments}) for content in contents]
    return [
        pair
        for i, earlier in enumerate(ids)
        for later in ids[i + 1 :]
        for target in earlier
        for source in later
        if source.area == target.area and source != target
        if (pair := FragmentPair(source, target)) not in asked
        and FragmentPair(target, source) not in asked
    ]


def _is_ground_truth(message: RawMessage) -> bool:
    return message.topic.rsplit("/", 1)[-1] == topics.GROUND_TRUTH.name


def _fragment_id(message: RawMessage) -> str:
    return str(decode(message).id)


def main(args: list[str] | None = None) -> None:
    """Entry point of the node."""
    sys.exit(run_node(FragmentPlayer, args))


if __name__ == "__main__":
    main()
