"""The ROS interface: every topic with its type and quality of service.

Names are relative, so that a namespace moves the whole graph. All topics are reliable. The
latched ones (transient local) give a late joiner what was published before it came.
"""

from __future__ import annotations

import re
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic.

    Attributes:
        name: relative name, without a leading slash unless it is global.
        type: `pkg/msg/Name`.
        latched: transient local rather than volatile.
        depth: messages that a publisher keeps; 0: all (bounded by what there is to publish).
    """

    name: str
    type: str
    latched: bool = True
    depth: int = 1


FRAGMENTS = Topic("fragments", "nss_msgs/msg/Fragment", depth=0)
FRAGMENT_PAIRS = Topic("fragment_pairs", "nss_msgs/msg/FragmentPair", depth=0)
GROUND_TRUTH = Topic("ground_truth", "nss_msgs/msg/PoseGraph", depth=0)
PLAYBACK_STATUS = Topic("playback_status", "nss_msgs/msg/PlaybackStatus")
RELATIVE_TRANSFORMS = Topic("relative_transforms", "nss_msgs/msg/RelativeTransform", depth=0)
POSE_GRAPH = Topic("pose_graph", "nss_msgs/msg/PoseGraph")
FRAGMENT_POSES = Topic("fragment_poses", "nss_msgs/msg/FragmentPoses")
MAP = Topic("map", "sensor_msgs/msg/PointCloud2")
MARKERS = Topic("markers", "visualization_msgs/msg/MarkerArray")
TF = Topic("/tf", "tf2_msgs/msg/TFMessage", latched=False, depth=100)
CLOCK = Topic("/clock", "rosgraph_msgs/msg/Clock", latched=False, depth=1)
DIAGNOSTICS = Topic("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray", latched=False, depth=10)


# Components that are published; those after the twelve largest are crumbs.
MOST_COMPONENTS = 12


def stage_map(stage: int) -> Topic:
    """The latched map of one stage, in the largest component."""
    return Topic(f"{MAP.name}/stage_{stage}", MAP.type)


def component_map(component: int) -> Topic:
    """The latched map of a component; the largest, 0, is the map."""
    return Topic(f"{MAP.name}/component_{component}", MAP.type) if component else MAP


def component_markers(component: int) -> Topic:
    """The latched markers of a component; those of the largest, 0, have the plain name."""
    return Topic(f"{MARKERS.name}/component_{component}", MARKERS.type) if component else MARKERS


def part_of_map(name: str) -> Topic | None:
    """The topic of a stage or of a further component by its relative name."""
    number = re.search(r"_(\d+)$", name)
    if number is None:
        return None
    named = (part(int(number[1])) for part in (stage_map, component_map, component_markers))
    return next((topic for topic in named if topic.name == name), None)


def component_frame(map_frame: str, component: int) -> str:
    """Frame of a component: nothing is known of how it lies to the others."""
    return f"{map_frame}_{component}" if component else map_frame
