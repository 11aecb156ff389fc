"""Scans that reach far, by a scanner of its own that looks at a small procedural floor."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch

from nss_ros.config import MultiwayConfig, RegistrationConfig, SiteConfig
from nss_ros.fragment import Fragment, FragmentId, FragmentPair, voxelize
from nss_ros.geometry import from_yaw, inverse, relative, rotation_angle, transform_points
from nss_ros.multiway.choi import Choi
from nss_ros.multiway.pose_graph import Alternative, Measurement
from nss_ros.multiway.solver import prepared_by
from nss_ros.multiway.submap_joining import joined_submaps
from nss_ros.registration.gravity.canvas import Canvas, canvas_score, canvas_search
from nss_ros.registration.gravity.correlation import turned_spectra
from nss_ros.registration.gravity.network import CHANNELS, as_target
from nss_ros.registration.gravity.raster import SIZE
from nss_ros.registration.gravity.refinement import SIGNS
from nss_ros.registration.gravity.scan import WIDE_SIZE, is_wide_scan, scan_of, wide_scan_of
from nss_ros.registration.gravity.search import Peak, Search, search
from nss_ros.registration.gravity.wide import is_wide, weighed, wide_search
from nss_ros.registration.method import load_method
from nss_ros.registration.relative_transform import Reason
from nss_ros.simulation.procedural.floor import build_floor
from nss_ros.simulation.scene import Scene

CONFIG = RegistrationConfig(method="gravity")
PLACES = {
    FragmentId("1", 1, 1): (6.0, 5.0, 1.6, 0.4),
    FragmentId("1", 1, 2): (12.5, 6.5, 1.75, 2.1),
    FragmentId("1", 2, 1): (9.0, 5.5, 1.5, -1.3),
}


def laser_scan(scene, place, rng):
    """Points of a spherical pattern of 0.6 deg up to 30 m, sensor frame, and the pose."""
    x, y, height, yaw = place
    azimuth, elevation = np.meshgrid(np.arange(0, 360, 0.6), np.arange(-60, 90, 0.6))
    azimuth, elevation = np.radians(azimuth.ravel()), np.radians(elevation.ravel())
    level = np.cos(elevation)
    rays = np.stack((level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)), axis=1)
    pose = from_yaw(yaw, (x, y, height))
    distances = scene.cast(pose[:3, 3], rays @ pose[:3, :3].T).distances.astype(np.float64)
    hit = (distances > 0.4) & (distances < 30)
    distances = distances[hit] + rng.normal(0, 0.003, hit.sum())
    return voxelize(rays[hit] * distances[:, None], 0.05), pose


@pytest.fixture(scope="module")
def site():
    """Fragments and true poses of two spots of the first stage and of one of the second."""
    plan = SiteConfig(use="office", width=24, depth=14, stages=3)
    floor = build_floor("1", plan, 3)
    rng = np.random.default_rng(1)
    fragments, poses = {}, {}
    for id_, place in PLACES.items():
        points, pose = laser_scan(Scene(floor.stage_mesh(id_.stage).mesh), place, rng)
        fragments[id_], poses[id_] = Fragment(id_, points, True), pose
    return fragments, poses


@pytest.fixture(scope="module")
def method():
    return load_method(CONFIG)


@pytest.fixture(scope="module")
def features(method, site):
    fragments, _ = site
    return {id_: method.prepare(fragment) for id_, fragment in fragments.items()}


ONE, OTHER, LATER = PLACES


def test_they_have_wide_maps_and_no_other_features(site, features):
    fragments, _ = site
    for id_ in PLACES:
        assert is_wide_scan(fragments[id_])
        assert features[id_].maps.shape[-1] == WIDE_SIZE // 2
        assert features[id_].generic is None


@pytest.mark.parametrize(
    ("source", "target", "least"), [(ONE, OTHER, 0.8), (OTHER, ONE, 0.8), (ONE, LATER, 0.6)]
)
def test_they_are_registered_and_known_to_be_right(method, site, features, source, target, least):
    _, poses = site
    answer = method.register(features[source], features[target], 0)
    error = relative(answer.T_target_source, relative(poses[source], poses[target]))
    assert np.linalg.norm(error[:3, 3]) < 0.1
    assert np.degrees(rotation_angle(error)) < 1
    assert answer.confidence > least
    total = answer.confidence + sum(each.probability for each in answer.alternatives)
    assert total <= 1 + 1e-6


def test_they_have_no_second_look(method, features):
    found = method.candidates(features[ONE], features[LATER])
    numbers = [SIGNS.index(name) for name in ("comparison", "comparison_margin")]
    assert not np.stack([each.signs for each in found])[:, numbers].any()


def test_of_two_buildings_the_confidence_is_lower(method, features):
    confidences: dict[int, list[float]] = {1: [], 3: []}
    for use, width in (("hospital", 24), ("laboratory", 30)):
        floor = build_floor("2", SiteConfig(use=use, width=width, depth=14, stages=3), 4)
        for stage in (1, 3):
            scene, rng = Scene(floor.stage_mesh(stage).mesh), np.random.default_rng(2)
            points, _ = laser_scan(scene, PLACES[ONE], rng)
            elsewhere = method.prepare(Fragment(FragmentId("2", stage, 1), points, True))
            answer = method.register(features[ONE], elsewhere, 0)
            confidences[stage].append(answer.confidence)
    # Two bare shells of one size look alike; still each is below those that are right.
    right = [
        method.register(features[ONE], features[each], 0).confidence for each in (OTHER, LATER)
    ]
    assert max(confidences[1]) < min(0.8, *right)
    assert max(confidences[3]) < 0.15


def test_an_unsure_answer_is_that_of_the_surer_maps(method, features, monkeypatch):
    """Whichever it is, what the other maps found stays among the hypotheses."""
    ends = features[ONE], features[LATER]
    monkeypatch.setattr("nss_ros.registration.gravity.method._SURE", 0.0)
    wide = method.register(*ends, 0)
    monkeypatch.setattr("nss_ros.registration.gravity.method._SURE", 1.1)
    answer = method.register(*ends, 0)
    usual = method.register(*(each.near for each in ends), 0)
    assert answer.confidence == max(wide.confidence, usual.confidence)
    better = max(wide, usual, key=lambda each: each.confidence)
    assert np.array_equal(answer.T_target_source, better.T_target_source)
    assert len(answer.alternatives) >= len(better.alternatives)
    probabilities = [each.probability for each in answer.alternatives]
    assert probabilities == sorted(probabilities, reverse=True)
    assert answer.confidence + sum(probabilities) <= 1 + 1e-6


def test_where_all_is_far_wide_maps_are_all_there_is(method, site, features):
    fragments, _ = site
    points = fragments[ONE].points * np.float32(20)
    beyond = points[np.linalg.norm(points, axis=1) > 13]
    far = method.prepare(Fragment(ONE, beyond, True))
    assert far.shape is not None
    assert far.near is None
    assert method.register(far, features[OTHER], 0).reason is Reason.NONE


@pytest.mark.parametrize("turned", [False, True])
def test_one_with_wide_maps_is_registered_with_a_usual_one(method, site, features, turned):
    fragments, poses = site
    points = fragments[LATER].points
    near = Fragment(LATER, points[np.linalg.norm(points, axis=1) < 4.5], True)
    assert not is_wide_scan(near)
    both = [features[ONE], method.prepare(near)]
    truth = relative(poses[ONE], poses[LATER])
    answer = method.register(*(both[::-1] if turned else both), 0)
    found = inverse(answer.T_target_source) if turned else answer.T_target_source
    hypotheses = [found]
    for each in answer.alternatives:
        T = each.T_target_source
        hypotheses.append(inverse(T) if turned else T)
    errors = [relative(each, truth) for each in hypotheses]
    assert answer.reason is Reason.NONE
    assert min(np.linalg.norm(each[:3, 3]) for each in errors) < 0.2


@pytest.mark.parametrize("reach", [30.0, 4.5])
def test_on_a_canvas_they_find_the_place_of_one_that_sees_more_or_less(site, reach):
    fragments, poses = site
    points = fragments[LATER].points
    later = Fragment(LATER, points[np.linalg.norm(points, axis=1) < reach], True)
    prepared = prepared_by(MultiwayConfig(), (fragments[ONE], fragments[OTHER], later))
    assert [prepared[each].seen.shape[-1] for each in (ONE, OTHER)] == [WIDE_SIZE // 2] * 2
    raised = prepared[ONE].at_floor(prepared[ONE].floor + 0.1)
    assert raised.maps.shape == prepared[ONE].maps.shape
    target = Canvas.of({each: poses[each] for each in (ONE, OTHER)}, prepared)
    source = Canvas.of({LATER: np.eye(4)}, prepared)
    found = canvas_search(source, target, 5)
    errors = [np.linalg.norm((each - poses[LATER])[:2, 3]) for each in found]
    assert min(errors) < 0.5
    best = found[int(np.argmin(errors))]
    assert canvas_score(source, target, best) > canvas_score(source, target, np.eye(4)) + 10


def test_within_a_stage_a_place_that_cannot_be_is_not_taken_however_sure_a_pair_is(site):
    fragments, poses = site
    config = MultiwayConfig(synchronizer="submaps")
    prepared = prepared_by(config, (fragments[ONE], fragments[OTHER]))
    truth = relative(poses[ONE], poses[OTHER])
    beside = truth.copy()
    beside[:2, 3] += (3.0, 0.6)
    sure = Measurement(
        FragmentPair(ONE, OTHER),
        beside,
        confidence=0.9,
        level=True,
        alternatives=(Alternative(truth, np.eye(6), 0.05),),
    )
    (part,) = joined_submaps([ONE, OTHER], [sure], prepared, Choi(config)).parts
    assert np.linalg.norm((relative(part[ONE], part[OTHER]) - truth)[:3, 3]) < 0.1
    # But a person is right.
    manual = replace(sure, manual=True)
    (part,) = joined_submaps([ONE, OTHER], [manual], prepared, Choi(config)).parts
    assert np.linalg.norm((relative(part[ONE], part[OTHER]) - beside)[:3, 3]) < 0.1


def test_the_same_bytes_come_again_and_after_pickling(method, features):
    first = method.register(features[ONE], features[OTHER], 0)
    copies = pickle.loads(pickle.dumps((features[ONE], features[OTHER])))
    again = method.register(*copies, 1)
    assert first.T_target_source.tobytes() == again.T_target_source.tobytes()
    assert first.confidence == again.confidence


def test_the_floor_is_that_of_the_tripod_not_the_ground_far_below():
    rng = np.random.default_rng(0)
    floor, ground = rng.uniform(-4, 4, (9000, 3)), rng.uniform(-15, 15, (120_000, 3))
    floor[:, 2], ground[:, 2] = -1.6, -3.1
    ground = ground[np.abs(ground[:, :2]).max(axis=1) > 5]
    wall = rng.uniform(-4, 4, (4000, 3))
    wall[:, 0], wall[:, 2] = 4, wall[:, 2] / 4
    points = np.concatenate((floor, ground, wall)).astype(np.float32)
    fragment = Fragment(ONE, points, True)
    assert wide_scan_of(fragment, CONFIG).floor.height == pytest.approx(-1.6, abs=0.03)


def patch(rng, size):
    return torch.from_numpy(rng.normal(0, 0.05, (CHANNELS, size, size)).astype(np.float32))


@pytest.mark.parametrize("corner", [(0, 0), (72, 72), (72, 4), (36, 40)])
@pytest.mark.parametrize("small_moves", [True, False])
def test_a_small_map_is_found_anywhere_on_a_wide_one(corner, small_moves):
    # Smooth, as features are: coarse cells must be like fine ones.
    wide = torch.nn.functional.interpolate(patch(np.random.default_rng(2), 30)[None], size=120)[0]
    row, column = corner
    small = wide[:, row : row + 48, column : column + 48].contiguous()
    # As a target, surfaces meet free space: only what counts for both is compared.
    wide, small = wide.clone(), small.clone()
    for each in (wide, small):
        each[26:] = 0
    x, y = (column + 24 - 60) * 0.2, (row + 24 - 60) * 0.2
    if small_moves:
        best = wide_search(small, as_target(wide)).peaks[0]
    else:
        best, x, y = wide_search(wide, as_target(small)).peaks[0], -x, -y
    assert min(best.yaw, 2 * np.pi - best.yaw) < 0.03
    assert best.x == pytest.approx(x, abs=0.11)
    assert best.y == pytest.approx(y, abs=0.11)


def test_usual_maps_have_the_best_pose_of_the_full_search(method, site):
    fragments, _ = site
    prepared = [method.prepare_scan(scan_of(fragments[each], CONFIG)) for each in (ONE, LATER)]
    source, target = (torch.from_numpy(each.maps[0]) for each in prepared)
    assert source.shape[-1] == SIZE // 2
    assert not is_wide(source, target)
    full = search(turned_spectra(source), as_target(target), 5)
    quick = wide_search(source, as_target(target))
    best, other = full.peaks[0], quick.peaks[0]
    assert other.score == pytest.approx(best.score, abs=0.01)
    assert (other.x, other.y) == pytest.approx((best.x, best.y), abs=0.05)
    assert quick.evidence <= full.evidence + 1e-3


def test_a_pose_that_puts_walls_into_seen_free_space_falls_behind(site, features):
    _, poses = site
    truth = relative(poses[ONE], poses[OTHER])
    yaw = float(np.arctan2(truth[1, 0], truth[0, 0]))
    right = Peak(yaw, float(truth[0, 3]), float(truth[1, 3]), 10.0, -2.0)
    wrong = Peak(yaw + 0.5, right.x + 2.0, right.y, 12.0, -0.2)
    shapes = features[ONE].shape, features[OTHER].shape
    found = weighed(Search((wrong, right), 3.0), *shapes, same_stage=True, count=2)
    assert found.peaks[0].x == right.x
    assert found.evidence < 3.0
    assert sum(np.exp(peak.mass) for peak in found.peaks) == pytest.approx(1)
    assert len(weighed(found, *shapes, same_stage=True, count=1).peaks) == 1


def test_points_of_nowhere_and_of_other_storeys_do_no_harm(method, site, features):
    fragments, poses = site
    rng = np.random.default_rng(4)
    points = fragments[ONE].points
    below = rng.uniform((2, -3, -4.9), (8, 3, -4.8), (4000, 3)).astype(np.float32)
    broken = np.full((50, 3), np.nan, dtype=np.float32)
    fragment = Fragment(ONE, np.concatenate((points, below, broken)), True)
    answer = method.register(method.prepare(fragment), features[OTHER], 0)
    truth = relative(poses[ONE], poses[OTHER])
    assert np.linalg.norm(answer.T_target_source[:3, 3] - truth[:3, 3]) < 0.1


def test_a_moved_frame_moves_the_answer(method, site, features):
    fragments, poses = site
    turn = from_yaw(0.8, (0.0, 0.0, 0.0))
    points = transform_points(turn, fragments[OTHER].points).astype(np.float32)
    moved = method.prepare(Fragment(OTHER, points, True))
    answer = method.register(features[ONE], moved, 0)
    error = relative(answer.T_target_source, turn @ relative(poses[ONE], poses[OTHER]))
    assert np.linalg.norm(error[:3, 3]) < 0.1
