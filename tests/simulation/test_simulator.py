import numpy as np
import pytest

from nss_ros.config import RigConfig, SimulationConfig, SiteConfig, ViewpointConfig
from nss_ros.geometry import inverse, transform_points
from nss_ros.multiway.pose_graph import EdgeKind, NodeStatus
from nss_ros.simulation.procedural.floor import build_floor
from nss_ros.simulation.scene import Scene
from nss_ros.simulation.simulator import bag_metadata, ground_truth_graph, simulate_scans

CONFIG = SimulationConfig(
    seed=7,
    voxel_size=0.1,
    site=SiteConfig(stages=2),
    viewpoints=ViewpointConfig(spots_per_stage=3),
    rig=RigConfig(image_width=80, image_height=60),
)


@pytest.fixture(scope="module")
def scans():
    return simulate_scans(CONFIG)


@pytest.fixture(scope="module")
def graph(scans):
    return ground_truth_graph(CONFIG, scans)


def test_fragments_are_of_both_stages_in_canonical_order(scans):
    assert [str(scan.fragment.id) for scan in scans] == [
        f"Bldg1_Stage{stage}_Spot{spot}" for stage in (1, 2) for spot in (1, 2, 3)
    ]
    for scan in scans:
        assert scan.fragment.gravity_aligned
        assert scan.fragment.points.dtype == np.float32
        assert len(scan.fragment.points) > 1000


def test_points_lie_on_the_site_at_their_pose(scans):
    site = build_floor("1", CONFIG.site, CONFIG.seed)
    for scan in scans:
        scene = Scene(site.stage_mesh(scan.fragment.id.stage).mesh)
        points = transform_points(scan.T_map_fragment, scan.fragment.points)
        distance = scene.distance(points)
        assert np.median(distance) < 0.02
        assert np.quantile(distance, 0.99) < 0.15
        assert np.linalg.norm(scan.fragment.points, axis=1).max() < 4.8


def test_spots_differ_between_stages(scans):
    first, second = (
        np.array([s.T_map_fragment[:2, 3] for s in scans if s.fragment.id.stage == stage])
        for stage in (1, 2)
    )
    assert not np.isclose(first[:, None], second[None]).all(axis=2).any()


def test_same_seed_same_bytes_and_other_seed_other_bytes(scans):
    again = simulate_scans(CONFIG)
    assert [s.fragment.points.tobytes() for s in again] == [
        s.fragment.points.tobytes() for s in scans
    ]
    other = simulate_scans(CONFIG.model_copy(update={"seed": 8}))
    assert other[0].fragment.points.tobytes() != scans[0].fragment.points.tobytes()


def test_the_graph_holds_poses_and_pairs_in_one_direction(scans, graph):
    assert graph.name == "Bldg1_Graph1"
    assert [node.id for node in graph.nodes] == [scan.fragment.id for scan in scans]
    assert {node.status for node in graph.nodes} == {NodeStatus.PLACED}
    poses = {node.id: node.T_map_fragment for node in graph.nodes}
    assert graph.edges
    for edge in graph.edges:
        pair = edge.pair
        assert pair.source < pair.target
        assert edge.overlap_ratio >= CONFIG.min_overlap
        assert 0 <= edge.temporal_change <= 1
        assert (edge.kind is EdgeKind.SAME_STAGE) == pair.same_stage
        expected = inverse(poses[pair.target]) @ poses[pair.source]
        assert np.allclose(edge.T_target_source, expected)
    assert len({edge.pair for edge in graph.edges}) == len(graph.edges)


def test_metadata_names_every_setting():
    metadata = bag_metadata(CONFIG)
    assert metadata["generator"] == "nss simulate"
    assert metadata["simulation.seed"] == "7"
    assert metadata["simulation.rig.image_width"] == "80"
    assert metadata["simulation.area"] == "1"
    assert len(metadata) > 30
