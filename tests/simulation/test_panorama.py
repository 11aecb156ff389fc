import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from nss_ros.config import RigConfig
from nss_ros.dataset.depth_image import read_depth_image, write_depth_image
from nss_ros.fragment import voxelize
from nss_ros.simulation.mesh import box, merge
from nss_ros.simulation.panorama import panorama, panorama_points, panorama_ranges
from nss_ros.simulation.rig import scan
from nss_ros.simulation.scene import Scene


@pytest.fixture(scope="module")
def returns():
    """What the rig sees, up to 10 m, in a hall with a pillar."""
    walls = [box((-4, -7, 0), (-3.9, 7, 3)), box((3, -7, 0), (3.1, 7, 3))]
    ends = [box((-4, 6.9, 0), (3, 7, 3)), box((-4, -7, 0), (3, -6.9, 3))]
    slabs = [box((-4, -7, -0.2), (3, 7, 0)), box((-4, -7, 3), (3, 7, 3.2))]
    scene = Scene(merge([*walls, *ends, *slabs, box((1, 1, 0), (1.4, 1.4, 3))]))
    pose = np.eye(4)
    pose[2, 3] = 1.6
    return scan(scene, pose, RigConfig(), np.random.default_rng(0), reach=10.0)


def official_cloud(image, cut=4.5):
    """As the release's pan_to_pcd.py makes points of a panorama, before it voxelises."""
    height, width = image.shape
    depth = image.astype(float) / 65535 * 10
    lat = np.linspace(np.pi / 2, -np.pi / 2, height)[:, None]
    lon = np.linspace(0, 2 * np.pi, width)[None]
    z = depth * np.sin(lat)
    x = -depth * np.cos(lat) * np.sin(lon)
    y = depth * np.cos(lat) * np.cos(lon)
    return np.stack((x, y, z), axis=-1)[depth <= cut]


def test_the_official_tool_makes_the_fragment_of_the_panorama(returns, tmp_path):
    path = tmp_path / "pano.png"
    write_depth_image(path, panorama(returns.points, 512))
    cloud = voxelize(official_cloud(read_depth_image(path)), 0.075)
    fragment = voxelize(returns.within(4.5).points, 0.075)
    there = cKDTree(fragment).query(cloud)[0]
    back = cKDTree(cloud).query(fragment)[0]
    assert np.quantile(there, 0.99) < 0.075
    assert np.quantile(back, 0.99) < 0.075
    assert there.max() < 0.3
    assert len(cloud) == pytest.approx(len(fragment), rel=0.1)


def test_our_points_are_those_of_the_official_tool(returns):
    image = panorama(returns.points, 128)
    np.testing.assert_allclose(
        panorama_points(panorama_ranges(image), 4.5), official_cloud(image), atol=1e-5
    )


def test_it_sees_farther_than_the_fragment(returns):
    ranges = panorama_ranges(panorama(returns.points, 256))
    assert 6 < ranges[np.isfinite(ranges)].max() < 10
    assert ranges.shape == (256, 512)


def test_no_return_is_the_largest_value_and_cut_by_the_official_tool():
    image = panorama(np.zeros((0, 3), np.float32), 32)
    assert (image == 65535).all()
    assert len(official_cloud(image)) == 0
    far = panorama(np.array([[0, 0, 10.5]], np.float32), 32)
    assert (far == 65535).all()


@given(
    st.floats(0.5, 9.9), st.floats(-1.4, 1.4), st.floats(0, 2 * np.pi), st.sampled_from([64, 200])
)
def test_a_point_comes_back_within_a_pixel(distance, latitude, longitude, height):
    level = distance * np.cos(latitude)
    point = np.array(
        [-level * np.sin(longitude), level * np.cos(longitude), distance * np.sin(latitude)]
    )
    image = panorama(point[None].astype(np.float32), height)
    cloud = panorama_points(panorama_ranges(image), 10.0)
    assert 1 <= len(cloud) <= 2  # the first column and the last are one
    assert np.abs(np.linalg.norm(cloud, axis=1) - distance).max() < 1e-3
    assert np.linalg.norm(cloud - point, axis=1).max() < distance * np.pi / (height - 1)


def test_the_nearest_of_two_points_in_one_direction_stays():
    points = np.array([[0, 3.0, 0], [0, 2.0, 0]], np.float32)
    ranges = panorama_ranges(panorama(points, 65))
    assert ranges.min() == pytest.approx(2.0, abs=1e-3)
    assert set(np.round(ranges[np.isfinite(ranges)], 2)) == {2.0}


def test_single_holes_are_filled_only_on_one_surface():
    height, width = 65, 130
    angle = 2 * np.pi / (width - 1)

    def at(column, distance):
        return (-distance * np.sin(column * angle), distance * np.cos(column * angle), 0.0)

    points = np.array([at(10, 3.0), at(12, 3.1), at(20, 3.0), at(22, 4.0)], np.float32)
    row = panorama_ranges(panorama(points, height))[32]
    assert row[11] == pytest.approx(3.05, abs=1e-3)
    assert np.isinf(row[[9, 13, 21]]).all()
