"""Features by fragment, and the frames in which answers are given."""

import numpy as np
import pytest

from nss_ros.config import RegistrationConfig
from nss_ros.fragment import Fragment, FragmentId, FragmentPair
from nss_ros.geometry import exponential, inverse, relative, rotation_angle, transform_points
from nss_ros.registration.feature_store import (
    FeatureStore,
    feature_file,
    forget_features,
    fragment_file,
    store_fragment,
)
from nss_ros.registration.method import load_method
from nss_ros.standpoint import is_origin, shift

FIRST, SECOND, FOOT = FragmentId("1", 1, 0), FragmentId("1", 1, 1), FragmentId("1", 1, 2)
CONFIG = RegistrationConfig(method="gravity")
UP = np.array([0.0, 0.0, 1.4])


@pytest.fixture(scope="module")
def store(tmp_path_factory, room):
    folder = tmp_path_factory.mktemp("store")
    one, other = room.fragments[:2]
    on_floor = Fragment(FOOT, (other.points + UP).astype(np.float32), True)
    for fragment in (one, other, on_floor):
        store_fragment(folder, fragment, CONFIG.voxel_size)
    return FeatureStore(load_method(CONFIG), folder, folder, 1 << 28)


def test_answers_are_for_the_frames_that_the_fragments_came_in(store):
    place = store.get(FOOT).standpoint
    assert np.allclose(place, shift(UP), atol=0.3)
    assert is_origin(store.get(FIRST).standpoint)
    usual = store.register(FragmentPair(FIRST, SECOND), CONFIG)
    ahead = store.register(FragmentPair(FIRST, FOOT), CONFIG)
    back = store.register(FragmentPair(FOOT, FIRST), CONFIG)
    assert usual.ok
    expected = shift(UP) @ usual.T_target_source
    assert np.allclose(ahead.T_target_source, expected, atol=0.05)
    assert np.allclose(back.T_target_source @ ahead.T_target_source, np.eye(4), atol=0.05)
    assert ahead.confidence > 0.5 * usual.confidence


def test_tilted_scanners_are_registered_as_upright_ones_in_their_own_frames(store, tmp_path, room):
    tilts = [exponential(np.r_[np.zeros(3), np.radians(each)]) for each in ((3, 1, 0), (-2, 2, 0))]
    for fragment, tilt in zip(room.fragments[:2], tilts, strict=True):
        points = transform_points(inverse(tilt), fragment.points).astype(np.float32)
        store_fragment(tmp_path, Fragment(fragment.id, points, True), CONFIG.voxel_size)
    tilted = FeatureStore(store.method, tmp_path, tmp_path, 1 << 28)
    told = tilted.prepare(FIRST)
    assert told.standpoint is not None
    assert not is_origin(told.standpoint)
    assert told.warning == ""
    usual = store.register(FragmentPair(FIRST, SECOND), CONFIG)
    answer = tilted.register(FragmentPair(FIRST, SECOND), CONFIG)
    expected = inverse(tilts[1]) @ usual.T_target_source @ tilts[0]
    error = relative(answer.T_target_source, expected)
    assert np.linalg.norm(error[:3, 3]) < 0.05
    assert np.degrees(rotation_angle(error)) < 1.0


def test_features_are_kept_on_disk_with_the_standpoint(store, tmp_path, room):
    first = FeatureStore(store.method, store._fragments, tmp_path, 1 << 28)
    kept = first.get(FOOT).standpoint
    assert not is_origin(kept)
    without_fragments = FeatureStore(store.method, tmp_path, tmp_path, 1 << 28)
    assert np.array_equal(without_fragments.get(FOOT).standpoint, kept)
    store_fragment(tmp_path, room.fragments[0], CONFIG.voxel_size)
    forget_features(tmp_path)
    assert not feature_file(tmp_path, FOOT).exists()
    assert fragment_file(tmp_path, FIRST).exists()


def test_a_fragment_that_was_never_stored_is_said(store):
    answer = store.register(FragmentPair(FIRST, FragmentId("1", 1, 9)), CONFIG)
    assert not answer.ok
    assert "Features could not be computed" in answer.message


def test_origins_that_are_not_the_scanners_place_are_told(store):
    assert store.prepare(FIRST).warning == ""
    told = store.prepare(FOOT)
    assert str(FOOT) in told.warning
    assert "find_standpoints" in told.warning
    assert store.prepare(FragmentId("1", 1, 9)).standpoint is None


def test_origins_are_taken_for_the_scanners_place_on_request(store, tmp_path):
    trusting = FeatureStore(store.method, store._fragments, tmp_path, 1 << 28, False)
    told = trusting.prepare(FOOT)
    assert told.standpoint is not None
    assert is_origin(told.standpoint)
    assert told.warning == ""
