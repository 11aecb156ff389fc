import numpy as np
import pytest

from nss_ros.config import RigConfig, SimulationConfig, SiteConfig, ViewpointConfig
from nss_ros.errors import InputError
from nss_ros.fragment import FragmentId
from nss_ros.simulation.element import Element
from nss_ros.simulation.mesh import box
from nss_ros.simulation.panorama import panorama_points
from nss_ros.simulation.procedural.floor import build_floor
from nss_ros.simulation.scene import Scene
from nss_ros.simulation.simulator import choose_spots, simulate_site
from nss_ros.simulation.site import Rectangle, Site

CONFIG = SimulationConfig(
    voxel_size=0.1,
    viewpoints=ViewpointConfig(spots_per_stage=3),
    rig=RigConfig(image_width=80, image_height=60),
)


@pytest.fixture(scope="module")
def site():
    return build_floor("X1", SiteConfig(stages=2), 7)


@pytest.fixture(scope="module")
def scans(site):
    return list(simulate_site(site, CONFIG, 7, workers=1))


def all_bytes(scans):
    return [
        (scan.fragment.points.tobytes(), scan.normals.tobytes(), scan.elements.tobytes())
        for scan in scans
    ]


def depth_error(site, stage, T_map_fragment, points):
    """How far points (n, 3) are from what a ray towards them hits, metres."""
    directions = np.asarray(points, dtype=np.float64) @ T_map_fragment[:3, :3].T
    hits = Scene(site.stage_mesh(stage).mesh).cast(T_map_fragment[:3, 3], directions)
    lengths = np.linalg.norm(points, axis=1)
    return np.abs(hits.distances - 1) * lengths


def test_fragments_are_of_both_stages_in_canonical_order(scans):
    assert [str(scan.fragment.id) for scan in scans] == [
        f"BldgX1_Stage{stage}_Spot{spot}" for stage in (1, 2) for spot in (1, 2, 3)
    ]
    for scan in scans:
        assert scan.fragment.gravity_aligned
        assert scan.fragment.points.dtype == np.float32
        assert len(scan.fragment.points) > 1000


def test_points_lie_on_their_elements_and_normals_face_the_sensor(site, scans):
    for scan in scans:
        stage = scan.fragment.id.stage
        error = depth_error(site, stage, scan.T_map_fragment, scan.fragment.points)
        assert np.median(error) < 0.03
        assert np.quantile(error, 0.8) < 0.1  # at edges a voxel mixes two surfaces
        assert np.linalg.norm(scan.fragment.points, axis=1).max() < 4.8
        assert all(stage in site.elements[i].stages for i in np.unique(scan.elements))
        np.testing.assert_allclose(np.linalg.norm(scan.normals, axis=1), 1, atol=1e-4)
        towards = -np.einsum("ij,ij->i", scan.normals, scan.fragment.points)
        assert (towards > 0).mean() > 0.98


def test_spots_differ_between_stages(scans):
    first, second = (
        np.array([s.T_map_fragment[:2, 3] for s in scans if s.fragment.id.stage == stage])
        for stage in (1, 2)
    )
    assert not np.isclose(first[:, None], second[None]).all(axis=2).any()


def test_with_few_spots_a_later_stage_begins_near_the_first():
    long = build_floor("X2", SiteConfig(stages=3, width=60), 7)
    for seed in range(3):
        places = {spot.id: spot.place for spot in choose_spots(long, CONFIG, seed, workers=1)}
        first = [places[FragmentId("X2", stage, 1)][:2] for stage in (1, 2, 3)]
        assert np.linalg.norm(np.subtract(first[1:], first[0]), axis=1).max() < 15


def test_same_seed_same_bytes_whatever_the_workers_and_what_is_skipped(site, scans):
    assert all_bytes(simulate_site(site, CONFIG, 7, workers=2)) == all_bytes(scans)
    skip = {FragmentId("X1", 1, 2), FragmentId("X1", 2, 1)}
    rest = list(simulate_site(site, CONFIG, 7, workers=1, skip=skip))
    kept = [scan for scan in scans if scan.fragment.id not in skip]
    assert all_bytes(rest) == all_bytes(kept)
    other = next(iter(simulate_site(site, CONFIG, 8, workers=1)))
    assert other.fragment.points.tobytes() != scans[0].fragment.points.tobytes()


def test_areas_of_one_seed_differ(site, scans):
    renamed = Site("X2", site.stages, site.elements, site.extent)
    other = next(iter(simulate_site(renamed, CONFIG, 7, workers=1)))
    assert not np.allclose(other.T_map_fragment, scans[0].T_map_fragment)


def test_a_panorama_gives_the_same_surfaces_as_the_fragment(site):
    config = CONFIG.model_copy(update={"panorama": True, "panorama_height": 128})
    scan = next(iter(simulate_site(site, config, 7, workers=1)))
    assert scan.panorama is not None
    ranges = scan.panorama / 65535 * 10.0
    assert ranges.max() > 9.99  # nothing came back from some directions
    points = panorama_points(ranges, 4.5)
    error = depth_error(site, 1, scan.T_map_fragment, points)
    assert np.median(error) < 0.04


def test_a_site_without_floor_is_refused():
    wall = Element("wall", frozenset((1,)), box((0, 0, 1), (5, 0.2, 3)))
    site = Site("A", 1, (wall,), Rectangle(0, 0, 5, 5))
    with pytest.raises(InputError, match="Area A, stage 1: no free floor"):
        list(simulate_site(site, CONFIG, 0, workers=1))


def test_a_blocked_passage_is_told():
    floor = Element("slab", frozenset({1, 2}), box((0, 0, -0.2), (12, 6, 0)))
    wall = Element("wall", frozenset({2}), box((7.9, -1, 0), (8, 7, 3)))
    site = Site("A", 2, (floor, wall), Rectangle(0, 0, 12, 6))
    told = []
    scans = list(simulate_site(site, CONFIG, 0, workers=1, warn=told.append))
    assert {scan.fragment.id.stage for scan in scans} == {1, 2}
    (sentence,) = told
    assert "Area A, stage 2" in sentence
    assert "m2 of free floor in a region cut off" in sentence
    assert "min_region" in sentence
