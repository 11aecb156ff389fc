"""Node `registration`: answers every fragment pair with one relative transform.

Where nobody asks for pairs, it asks for the most promising ones itself.

Several of these nodes, on any hosts, share the pairs by a hash of the pair (`shard_index` of
`shard_count`). What it subscribes to holds no ground truth.
"""

from __future__ import annotations

import sys
import time
from queue import Empty, SimpleQueue

from rclpy.node import Node

from nss_msgs.msg import Fragment as FragmentMessage
from nss_msgs.msg import FragmentPair as PairMessage
from nss_msgs.msg import PlaybackStatus, PoseGraphEdge
from nss_msgs.msg import PoseGraph as PoseGraphMessage
from nss_msgs.msg import RelativeTransform as RelativeTransformMessage
from nss_ros import topics
from nss_ros.config import ProposalConfig, RegistrationConfig, RegistrationNodeConfig
from nss_ros.errors import ConfigError
from nss_ros.fragment import Fragment, FragmentId, FragmentPair
from nss_ros.messages import (
    fragment_from,
    pair_from,
    pair_message,
    relative_transform_message,
    rosidl_family,
)
from nss_ros.nodes.diagnostics import Health, publish_diagnostics
from nss_ros.nodes.intake import converted
from nss_ros.nodes.parameters import declare_parameters, follow_parameters
from nss_ros.nodes.qos import latest_qos, publisher_qos, subscription_qos
from nss_ros.nodes.spin import Background, run_node
from nss_ros.registration.method import load_method
from nss_ros.registration.pool import RegistrationPool
from nss_ros.registration.proposer import Proposer
from nss_ros.registration.relative_transform import Reason, RelativeTransform, failed
from nss_ros.registration.seed import shard_of

_POLL = 0.05

Event = Fragment | FragmentPair | RegistrationNodeConfig


class Registration(Node):
    """Registers pairs in worker processes; its executor only enqueues.

    Raises:
        ConfigError: a parameter is not valid.
        MethodError: the method is unknown or lacks something.
    """

    def __init__(self) -> None:
        super().__init__("registration")
        self._config = declare_parameters(self, RegistrationNodeConfig)
        _check(self._config)
        self._pool = RegistrationPool(self._config, self._config.workers, self._config.memory_limit)
        self._proposer = Proposer(*_proposing(self._config))
        self._events: SimpleQueue[Event] = SimpleQueue()
        self._fragments: set[FragmentId] = set()
        self._asked: set[FragmentPair] = set()
        self._answered: set[FragmentPair] = set()
        self._incomplete: list[FragmentPair] = []
        self._last_arrival = time.monotonic()
        self._failures = 0
        self._moved = 0
        self._create_interface()
        follow_parameters(self, RegistrationNodeConfig, self._events.put, _check)
        self.background = Background("register", self._work)
        self.background.start()

    def close(self) -> None:
        """End the workers."""
        self.background.stop()
        self._proposer.close()
        self._pool.close()

    def _create_interface(self) -> None:
        self._publisher = self.create_publisher(
            RelativeTransformMessage,
            topics.RELATIVE_TRANSFORMS.name,
            publisher_qos(topics.RELATIVE_TRANSFORMS),
        )
        for message_type, topic, callback, qos in (
            (PoseGraphMessage, topics.POSE_GRAPH, self._on_pose_graph, latest_qos),
            (PlaybackStatus, topics.PLAYBACK_STATUS, self._on_status, latest_qos),
            (FragmentMessage, topics.FRAGMENTS, self._on_fragment, subscription_qos),
            (PairMessage, topics.FRAGMENT_PAIRS, self._on_pair, subscription_qos),
        ):
            self.create_subscription(message_type, topic.name, callback, qos(topic))
        self._pairs = self.create_publisher(
            PairMessage, topics.FRAGMENT_PAIRS.name, publisher_qos(topics.FRAGMENT_PAIRS)
        )
        publish_diagnostics(self, self._health)

    def _on_fragment(self, message: FragmentMessage) -> None:
        fragment = converted(self, fragment_from, message)
        if fragment is not None:
            self._events.put(fragment)

    def _on_pair(self, message: PairMessage) -> None:
        pair = converted(self, pair_from, message)
        if pair is not None:
            self._events.put(pair)

    def _on_status(self, message: PlaybackStatus) -> None:
        """A player says at its start whether its bags hold pairs."""
        if message.pairs_total > 0:
            self._proposer.expect_pairs()

    def _on_pose_graph(self, message: PoseGraphMessage) -> None:
        """Remember what was answered, by this node before it was restarted for example."""
        answers = (edge for edge in message.edges if edge.kind != PoseGraphEdge.KIND_SUBMAP)
        pairs = (converted(self, pair_from, edge) for edge in answers)
        self._answered.update(pair for pair in pairs if pair)

    def _health(self) -> Health:
        open_pairs = len(self._asked - self._answered)
        # Read in this order while another thread counts: a fragment that is counted is undecided
        # before, and its pairs are counted before it is decided.
        fragments = len(self._fragments)
        undecided = self._proposer.undecided
        values = {
            "method": self._config.method,
            "fragments": fragments,
            "pairs": len(self._asked),
            "pairs_open": open_pairs,
            "failures": self._failures,
            "proposed": self._proposer.proposed,
            "undecided": undecided,
            "origins_not_at_scanner": self._moved,
        }
        if undecided:
            return True, f"{undecided} fragments wait for pairs", values
        return True, f"{open_pairs} pairs open" if open_pairs else "idle", values

    def _work(self) -> None:
        while not self.background.stopping.is_set():
            self._take_events()
            self._propose()
            self._give_up_on_incomplete()
            for result in self._pool.poll(_POLL):
                self._answer(result)
            self._warn_of_origins()

    def _warn_of_origins(self) -> None:
        for preparation in self._pool.take_prepared():
            if preparation.warning:
                self._moved += 1
                self.get_logger().warning(
                    f"{preparation.warning} Diagnostics count all such fragments.", once=True
                )

    def _take_events(self) -> None:
        while True:
            try:
                event = self._events.get_nowait()
            except Empty:
                return
            if isinstance(event, Fragment):
                self._add_fragment(event)
            elif isinstance(event, FragmentPair):
                self._add_pair(event)
            else:
                self._reconfigure(event)

    def _add_fragment(self, fragment: Fragment) -> None:
        self._last_arrival = time.monotonic()
        if fragment.id in self._fragments:
            self.get_logger().warning(
                f"Fragment {fragment.id} came again, as others may: the first is kept.", once=True
            )
            return
        self._proposer.add_fragment(fragment.id, self._pool.add_fragment(fragment))
        self._fragments.add(fragment.id)
        ready = [pair for pair in self._incomplete if self._complete(pair)]
        self._incomplete = [pair for pair in self._incomplete if not self._complete(pair)]
        for pair in ready:
            self._pool.submit(pair)

    def _add_pair(self, pair: FragmentPair) -> None:
        self._proposer.add_pair(pair)
        if shard_of(pair, self._config.shard_count) != self._config.shard_index:
            return
        if pair in self._asked or pair in self._answered:
            return
        self._asked.add(pair)
        self._last_arrival = time.monotonic()
        if self._complete(pair):
            self._pool.submit(pair)
        else:
            self._incomplete.append(pair)

    def _complete(self, pair: FragmentPair) -> bool:
        return pair.source in self._fragments and pair.target in self._fragments

    def _give_up_on_incomplete(self) -> None:
        quiet = time.monotonic() - self._last_arrival
        if not self._incomplete or quiet < self._config.fragment_timeout:
            return
        for pair in self._incomplete:
            missing = pair.target if pair.source in self._fragments else pair.source
            message = f"Fragment {missing} was never published."
            self._answer(failed(pair, self._config.method, Reason.UNKNOWN_FRAGMENT, message))
        self._incomplete.clear()

    def _answer(self, result: RelativeTransform) -> None:
        if result.pair in self._answered:
            return
        self._answered.add(result.pair)
        if not result.ok:
            self._failures += 1
            self.get_logger().debug(f"{result.pair}: {result.message}")
        stamp = self.get_clock().now().nanoseconds
        self._publisher.publish(relative_transform_message(result, stamp, rosidl_family()))

    def _propose(self) -> None:
        quiet = time.monotonic() - self._last_arrival
        for pair in self._proposer.poll(quiet):
            stamp = self.get_clock().now().nanoseconds
            self._pairs.publish(pair_message(pair, stamp, rosidl_family()))

    def _reconfigure(self, config: RegistrationNodeConfig) -> None:
        if config == self._config:
            return
        self._proposer.reconfigure(*_proposing(config))
        self._pool.reconfigure(config, config.workers, config.memory_limit)
        self._config = config


def _proposing(config: RegistrationNodeConfig) -> tuple[ProposalConfig, RegistrationConfig, int]:
    """Settings of the proposer; one of the nodes that share the pairs proposes them."""
    proposals = config.proposals
    if config.shard_index > 0:
        proposals = proposals.model_copy(update={"when": "never"})
    return proposals, config, config.workers


def _check(config: RegistrationNodeConfig) -> None:
    load_method(config)
    if config.shard_index >= config.shard_count:
        raise ConfigError(
            f"shard_index {config.shard_index} must be less than shard_count {config.shard_count}."
        )


def main(args: list[str] | None = None) -> None:
    """Entry point of the node."""
    sys.exit(run_node(Registration, args))


if __name__ == "__main__":
    main()
