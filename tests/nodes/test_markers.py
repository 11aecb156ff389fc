"""The pose graph as markers."""

import numpy as np
import pytest

from nss_ros.fragment import FragmentId
from nss_ros.geometry import from_yaw
from nss_ros.multiway.pose_graph import Node, NodeStatus, PoseGraph
from nss_ros.nodes.markers import graph_markers

pytestmark = pytest.mark.ros


def test_doubtful_places_have_a_marker_around_them():
    sure, unsure, elsewhere = (
        Node(FragmentId("1", 1, n), from_yaw(0, (n, 0, 0)), NodeStatus.PLACED, n // 2, doubtful=n)
        for n in range(3)
    )
    found = {
        each.ns: each for each in graph_markers(PoseGraph((sure, unsure, elsewhere)), "m").markers
    }
    (point,) = found["doubtful"].points
    assert (point.x, point.y, point.z) == (1, 0, 0)
    assert found["doubtful"].scale.x > found["stage_1"].scale.x
    assert np.isclose(found["doubtful"].color.a, 0.5)
    assert "doubtful" not in {each.ns for each in graph_markers(PoseGraph((sure,)), "m").markers}
