"""What carries a scanner, put beneath the fragments of the bundled bag."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nss_ros.bag import read_log
from nss_ros.carrier import without_carrier
from nss_ros.config import MultiwayConfig, RegistrationConfig
from nss_ros.fragment import Fragment, FragmentId, FragmentPair
from nss_ros.geometry import from_yaw, transform_points
from nss_ros.multiway.submap_fragment import submap_fragment
from nss_ros.registration.feature_store import FeatureStore, store_fragment
from nss_ros.registration.gravity.weights import load_weights
from nss_ros.registration.method import load_method
from nss_ros.standpoint import at_standpoint

BAG = Path(__file__).parents[1] / "bags" / "three_stages"


@pytest.fixture(scope="module")
def scans():
    return read_log(BAG).fragments


def robot():
    """Points (n, 3) of a body of 1.1 x 0.8 x 0.3 m beneath the sensor, and of a mast beside it."""
    rng = np.random.default_rng(5)
    outward = rng.normal(size=(4000, 3))
    outward /= np.linalg.norm(outward, axis=1)[:, None]
    outward[:, 2] = np.abs(outward[:, 2])
    body = outward * (0.55, 0.4, 0.33) + (0, 0, -0.65)
    mast = np.column_stack((np.full((200, 2), 0.12), rng.uniform(-0.2, 0.2, 200)))
    return np.concatenate((body, mast)).astype(np.float32)


def carried(fragment):
    """The fragment with the robot in it."""
    points = np.concatenate((fragment.points, robot()))
    return Fragment(fragment.id, points, fragment.gravity_aligned)


def test_a_robot_goes_and_all_else_stays(scans):
    for fragment in scans.values():
        expected = without_carrier(fragment.points)
        assert np.array_equal(without_carrier(carried(fragment).points), expected)


def test_of_a_fragment_without_one_hardly_anything_goes(scans):
    shares = [len(without_carrier(each.points)) / len(each.points) for each in scans.values()]
    assert min(shares) > 0.99
    assert np.median(shares) == 1


@given(st.floats(-np.pi, np.pi))
def test_it_is_the_same_however_the_scanner_is_turned(yaw):
    rng = np.random.default_rng(1)
    points = rng.uniform(-1.5, 1.5, (500, 3))
    # What is at the very limit may go or stay.
    turned = without_carrier(transform_points(from_yaw(yaw, (0, 0, 0)), points))
    back = transform_points(from_yaw(-yaw, (0, 0, 0)), turned)
    expected = without_carrier(points)
    assert len(back) == len(expected)
    assert np.allclose(back, expected)


def test_the_carrier_is_beneath_where_the_scanner_stood(scans):
    fragment = carried(next(iter(scans.values())))
    far = np.array([40.0, -25.0, 3.0])
    moved = Fragment(fragment.id, (fragment.points + far).astype(np.float32), True)
    seen, place = at_standpoint(moved)
    assert np.linalg.norm(place[:3, 3] - far) < 0.8
    assert len(seen.points) < len(fragment.points) - 3000


def test_of_what_is_not_levelled_nothing_goes(scans):
    """Where down is, nothing tells."""
    fragment = next(iter(scans.values()))
    loose = Fragment(fragment.id, carried(fragment).points, False)
    assert at_standpoint(loose)[0] is loose


def test_pairs_are_registered_as_without_it(scans, tmp_path):
    config = RegistrationConfig()
    pair = FragmentPair(FragmentId("1", 1, 3), FragmentId("1", 2, 3))
    answers = []
    for number, change in enumerate((lambda each: each, carried)):
        folder = tmp_path / str(number)
        folder.mkdir()
        for id_ in (pair.source, pair.target):
            store_fragment(folder, change(scans[id_]), config.voxel_size)
        store = FeatureStore(load_method(config), folder, folder, 1 << 30)
        answers.append(store.register(pair, config))
    assert answers[0].ok
    assert answers[0].T_target_source.tobytes() == answers[1].T_target_source.tobytes()


def test_submaps_do_not_see_it(scans):
    network = load_weights(MultiwayConfig().submap_weights).network
    fragment = next(iter(scans.values()))
    plain, other = (
        submap_fragment(each, network, RegistrationConfig())
        for each in (fragment, carried(fragment))
    )
    assert plain is not None
    assert other is not None
    assert np.array_equal(plain.points, other.points)
    assert np.array_equal(plain.maps, other.maps)
