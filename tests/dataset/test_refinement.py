import numpy as np
import pytest

from floor_scan import make_floor  # isort: skip
from nss_ros.config import RefinementConfig
from nss_ros.dataset.drift import drifted_poses
from nss_ros.dataset.folder import DatasetFolder
from nss_ros.dataset.refinement import (
    RefinedPair,
    radius_study,
    read_refined,
    refine_pair,
    refine_pairs,
    write_refined,
)
from nss_ros.dataset.refinement_figure import radius_figure
from nss_ros.dataset.stage_scan import dataset_scan, fitted_normals, scan_of_points
from nss_ros.errors import FormatError, InputError
from nss_ros.fragment import FragmentId, FragmentPair
from nss_ros.geometry import from_yaw, inverse, relative

CONFIG = RefinementConfig(max_points=4000)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    path = tmp_path_factory.mktemp("floor") / "dataset"
    make_floor(path)
    return DatasetFolder(path)


@pytest.fixture(scope="module")
def drifted(dataset):
    return drifted_poses(dataset.poses(), seed=2, sigma=0.04, length=15.0)


@pytest.fixture(scope="module")
def pairs(dataset):
    poses = dataset.poses()
    ids = dataset.fragment_ids()
    return [
        FragmentPair(source, target)
        for source in ids
        for target in ids
        if source.stage < target.stage
        and np.linalg.norm(poses[source][:2, 3] - poses[target][:2, 3]) < 2.5
    ][::2]


def errors(transforms, poses):
    """Distance of relative transforms from the true ones at the source spot, metres."""
    return np.array(
        [
            np.linalg.norm((inverse(relative(poses[p.source], poses[p.target])) @ transform)[:3, 3])
            for p, transform in transforms.items()
        ]
    )


def test_refinement_undoes_drift_despite_change(dataset, drifted, pairs):
    before = {p: relative(drifted[p.source], drifted[p.target]) for p in pairs}
    refined = refine_pairs(dataset, pairs, CONFIG, drifted, workers=1)
    assert list(refined) == pairs
    after = {pair: result.T_target_source for pair, result in refined.items()}
    truth = dataset.poses()
    assert np.mean([result.accepted for result in refined.values()]) > 0.9
    assert np.median(errors(before, truth)) > 0.04
    assert np.median(errors(after, truth)) < 0.5 * np.median(errors(before, truth))
    for pair in pairs:
        moved = inverse(before[pair]) @ after[pair]
        assert np.linalg.norm(moved[:3, 3]) < 0.3


def test_exact_poses_stay(dataset, pairs):
    refined = refine_pairs(dataset, pairs[:4], CONFIG, workers=1)
    after = {pair: result.T_target_source for pair, result in refined.items()}
    assert errors(after, dataset.poses()).max() < 0.01


def test_the_same_for_any_number_of_workers(dataset, drifted, pairs):
    one = refine_pairs(dataset, pairs[:4], CONFIG, drifted, workers=1)
    two = refine_pairs(dataset, pairs[:4], CONFIG, drifted, workers=2)
    for pair in pairs[:4]:
        np.testing.assert_array_equal(one[pair].T_target_source, two[pair].T_target_source)


def test_small_cylinders_are_ambiguous_and_large_ones_stable(dataset, drifted, pairs):
    reported = []
    study = radius_study(
        dataset,
        pairs,
        CONFIG,
        radii=(2.0, 6.0, 12.0),
        repeats=2,
        poses=drifted,
        truth=dataset.poses(),
        workers=1,
        report=reported.append,
    )
    small, middle, large = study
    assert [row.radius for row in study] == [2.0, 6.0, 12.0]
    assert set(reported) == set(pairs)
    assert np.isnan(small.step)
    assert np.isfinite(middle.step)
    assert large.step < middle.step
    assert large.accepted > small.accepted
    assert large.error < 0.7 * small.error
    assert large.error < 0.04


def test_the_figure_shows_what_is_known(dataset, pairs):
    study = radius_study(dataset, pairs[:1], CONFIG, radii=(8.0, 12.0), repeats=1, workers=1)
    assert np.isnan(study[0].error)
    (axes,) = radius_figure(study, chosen=12.0).axes
    labels = [line.get_label() for line in axes.lines]
    assert "12 m" in labels
    assert not any("truth" in label for label in labels)


def test_what_is_not_determined_keeps_the_global_alignment(dataset):
    """Between slabs alone nothing tells where one is."""
    scan = dataset_scan(dataset, "1", 1, 0.1)
    slabs = np.abs(scan.normals[:, 2]) > 0.9
    flat = type(scan)(scan.points[slabs], scan.normals[slabs])
    source, target = from_yaw(0.3, (11, 4, 1.6)), from_yaw(-1.0, (13, 4, 1.6))
    refined = refine_pair(flat, flat, source, target, CONFIG)
    assert "of freedom" in refined.reason
    np.testing.assert_allclose(refined.T_target_source, relative(source, target), atol=1e-12)
    far = refine_pair(flat, flat, from_yaw(0, (90, 0, 0)), from_yaw(0, (91, 0, 0)), CONFIG)
    assert far.reason == "only 0 correspondences"
    assert np.isinf(far.deviation)


def test_a_large_correction_is_not_believed(dataset):
    scan = dataset_scan(dataset, "1", 1, 0.1)
    source, target = from_yaw(0, (5, 4, 1.6)), from_yaw(0, (6, 4, 1.6))
    shifted = type(scan)(scan.points + np.array((0.12, 0, 0)), scan.normals)
    narrow = CONFIG.model_copy(update={"max_translation": 0.05})
    refined = refine_pair(shifted, scan, source, target, narrow)
    assert "is not believed" in refined.reason
    believed = refine_pair(shifted, scan, source, target, CONFIG)
    assert believed.accepted
    assert believed.translation == pytest.approx(0.12, abs=0.01)


def test_only_pairs_between_stages(dataset):
    first = FragmentId("1", 1, 1)
    for other in (FragmentId("1", 1, 2), FragmentId("2", 2, 1)):
        with pytest.raises(InputError, match="is not of two stages of one area"):
            refine_pairs(dataset, [FragmentPair(first, other)], CONFIG, workers=1)
    with pytest.raises(InputError, match=r"Bldg1_Stage2_Spot99 .* has no pose"):
        refine_pairs(dataset, [FragmentPair(first, FragmentId("1", 2, 99))], CONFIG, workers=1)
    with pytest.raises(InputError, match="needs pairs"):
        radius_study(dataset, [], CONFIG)


def test_results_are_kept_in_the_dataset(tmp_path):
    pair = FragmentPair(FragmentId("1", 1, 2), FragmentId("1", 2, 3))
    other = FragmentPair(FragmentId("1", 1, 1), FragmentId("1", 2, 3))
    refined = {
        pair: RefinedPair(from_yaw(0.1, (1, 2, 3)), "", 0.01, 0.002, 0.009, 700, 0.003),
        other: RefinedPair(np.eye(4), "only 3 correspondences", 0.0, 0.0, 0.0, 3, np.inf),
    }
    assert read_refined(tmp_path) == {}
    write_refined(tmp_path, refined)
    read = read_refined(tmp_path)
    assert list(read) == [other, pair]
    for each, result in refined.items():
        np.testing.assert_array_equal(read[each].T_target_source, result.T_target_source)
        assert read[each].reason == result.reason
        assert read[each].deviation == result.deviation
    path = tmp_path / "refined_pairs.jsonl"
    path.write_text(path.read_text() + '{"source": 3}\n')
    with pytest.raises(FormatError, match="does not hold refined pairs"):
        read_refined(tmp_path)


def test_drift_is_smooth_seeded_and_of_the_size_asked_for():
    poses = {
        FragmentId("1", stage, spot): from_yaw(0.1 * spot, (0.5 * spot, 0, 1.6))
        for stage in range(1, 40)
        for spot in range(1, 9)
    }
    drifted = drifted_poses(poses, seed=3, sigma=0.05, length=8.0)
    again = drifted_poses(poses, seed=3, sigma=0.05, length=8.0)
    moved = np.array([drifted[id_][:3, 3] - poses[id_][:3, 3] for id_ in poses])
    assert moved.std(axis=0) == pytest.approx([0.05] * 3, rel=0.4)
    steps = np.diff(moved.reshape(39, 8, 3), axis=1)
    assert steps.std() < 0.2 * moved.std()
    for id_ in poses:
        np.testing.assert_array_equal(drifted[id_], again[id_])


def test_fitted_normals_are_those_of_planes():
    rng = np.random.default_rng(0)
    normal = np.array((1.0, 2.0, -2.0)) / 3
    points = rng.uniform(-1, 1, (400, 3))
    points -= np.outer(points @ normal, normal)
    assert np.abs(fitted_normals(points) @ normal).min() > 0.999
    scan = scan_of_points(points, 0.1)
    assert not scan.oriented
    assert len(scan.points) < 400
    assert fitted_normals(points[:2]).shape == (2, 3)
