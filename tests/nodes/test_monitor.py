"""What a monitor takes for the end of a run, heard over DDS."""

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from nss_msgs.msg import FragmentPose, PlaybackStatus, PoseGraph
from nss_ros import topics
from nss_ros.nodes.monitor import Monitor

pytestmark = pytest.mark.ros

FRAGMENTS = 4


@pytest.fixture
def monitor():
    made = Monitor("", registration_nodes=2)
    yield made
    made.close()


@pytest.fixture
def say(graph, monitor):
    """Publish a message and let the monitor hear it; how far it is then."""
    types = {
        topics.PLAYBACK_STATUS: PlaybackStatus,
        topics.POSE_GRAPH: PoseGraph,
        topics.DIAGNOSTICS: DiagnosticArray,
    }
    publishers = {types[topic]: each for topic, each in graph.publishers(types).items()}
    graph.wait(lambda: all(each.get_subscription_count() for each in publishers.values()))

    def publish(message):
        publishers[type(message)].publish(message)
        return monitor.spin(1.0)

    return publish


def registration(name, fragments=FRAGMENTS, undecided=0, proposed=0):
    counts = {"fragments": fragments, "undecided": undecided, "proposed": proposed}
    values = [KeyValue(key=key, value=str(value)) for key, value in counts.items()]
    return DiagnosticArray(status=[DiagnosticStatus(name=f"/{name}", values=values)])


def pose_graph(answered):
    nodes = [FragmentPose() for _ in range(FRAGMENTS)]
    return PoseGraph(nodes=nodes, settled=True, pairs_answered=answered)


def test_a_run_waits_for_every_registration_node_and_for_what_it_proposes(say):
    say(PlaybackStatus(state=PlaybackStatus.STATE_FINISHED, fragments_total=FRAGMENTS))
    say(pose_graph(answered=0))
    # One of two that share the pairs; the other one, which proposes them, was not heard yet.
    assert not say(registration("registration_1")).complete
    assert not say(registration("registration_0", fragments=3)).complete
    assert not say(registration("registration_0", undecided=2)).complete
    progress = say(registration("registration_0", proposed=3))
    assert progress.decided
    assert progress.pairs_total == 3
    assert not progress.complete
    assert not say(pose_graph(answered=2)).complete
    assert say(pose_graph(answered=3)).complete


def test_fragments_of_doubtful_place_are_placed_and_told(say):
    statuses = (FragmentPose.STATUS_PLACED, FragmentPose.STATUS_DOUBTFUL, 0)
    nodes = [FragmentPose(id=str(number), status=each) for number, each in enumerate(statuses)]
    progress = say(PoseGraph(nodes=nodes))
    assert (progress.placed, progress.components, progress.doubtful) == (2, 1, ["1"])


def test_diagnostics_of_others_are_not_taken_for_a_registration_node(say):
    say(PlaybackStatus(state=PlaybackStatus.STATE_FINISHED, fragments_total=FRAGMENTS))
    say(pose_graph(answered=0))
    say(registration("registration_1"))
    assert not say(registration("another_site/registration_0")).complete
    assert say(registration("registration_0")).complete
