import numpy as np
import pytest
import yaml
from floor_scan import make_floor
from hypothesis import given
from hypothesis import strategies as st

from nss_ros.config import AlignmentConfig
from nss_ros.dataset.alignment import align_stages, aligned_poses, fit_rigid
from nss_ros.dataset.folder import DatasetFolder
from nss_ros.dataset.point_pairs import read_point_pairs
from nss_ros.dataset.stage_scan import StageScan, dataset_scan
from nss_ros.errors import FormatError, InputError
from nss_ros.fragment import FragmentId
from nss_ros.geometry import exponential, from_yaw, inverse, rotation_angle, transform_points

CONFIG = AlignmentConfig(max_points=10_000)
# Corners that stand in both stages of the floor.
CORNERS = np.array(
    [[0.0, 0.0, 0.0], [4.4, 3.0, 0.0], [18.0, 3.4, 2.8], [21.0, 5.0, 0.0], [7.0, 6.5, 2.8]]
)
# Stage 1 was scanned in a frame of its own.
T_ANCHOR_STAGE = from_yaw(2.1, (31.0, -12.0, 0.4)) @ exponential((0, 0, 0, 0.01, -0.02, 0))


@pytest.fixture(scope="module")
def stages(tmp_path_factory):
    """Points of stage 1 in its own frame and of stage 2, the anchor."""
    path = tmp_path_factory.mktemp("floor") / "dataset"
    make_floor(path, spots=10)
    first, second = (dataset_scan(DatasetFolder(path), "1", stage, 0.1) for stage in (1, 2))
    return {1: transform_points(inverse(T_ANCHOR_STAGE), first.points), 2: second.points}


def picks(noise=0.02, seed=0, corners=CORNERS):
    """Corners as a person picks them, in stage 1 and in the anchor stage."""
    rng = np.random.default_rng(seed)
    own = transform_points(inverse(T_ANCHOR_STAGE), corners)
    return own + rng.normal(0, noise, own.shape), corners + rng.normal(0, noise, corners.shape)


def write_yaml(path, points, anchors):
    rows = [
        {"point": p.tolist(), "anchor": a.tolist()} for p, a in zip(points, anchors, strict=True)
    ]
    path.write_text(yaml.safe_dump({"anchor": 2, "stages": {1: rows}}))
    return path


def write_csv(path, points, anchors):
    lines = ["stage,x,y,z,anchor_stage,anchor_x,anchor_y,anchor_z"]
    lines += [
        ",".join(map(str, (1, *p.tolist(), 2, *a.tolist())))
        for p, a in zip(points, anchors, strict=True)
    ]
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize("seed", range(3))
def test_rough_picks_and_icp_align_a_stage(tmp_path, stages, seed):
    file = write_yaml(tmp_path / "picks.yaml", *picks(seed=seed))
    done = []
    found = align_stages(file, stages, CONFIG, done.append)
    assert done == [1]
    np.testing.assert_array_equal(found[2].T_anchor_stage, np.eye(4))
    aligned = found[1]
    by_picks = fit_rigid(*picks(seed=seed))
    error = inverse(T_ANCHOR_STAGE) @ aligned.T_anchor_stage
    moved = transform_points(error, stages[1]) - stages[1]
    moved_by_picks = transform_points(inverse(T_ANCHOR_STAGE) @ by_picks, stages[1]) - stages[1]
    assert np.linalg.norm(moved, axis=1).max() < 0.02
    assert np.linalg.norm(moved, axis=1).max() < 0.8 * np.linalg.norm(moved_by_picks, axis=1).max()
    assert rotation_angle(error) < np.radians(0.1)
    assert aligned.residuals.shape == (5,)
    assert aligned.rmse < 0.03
    assert aligned.warnings == ()


def test_csv_and_yaml_say_the_same(tmp_path):
    one = read_point_pairs(write_yaml(tmp_path / "picks.yaml", *picks()))
    two = read_point_pairs(write_csv(tmp_path / "picks.csv", *picks()))
    assert one.anchor == two.anchor == 2
    np.testing.assert_array_equal(one.stages[1].points, two.stages[1].points)
    np.testing.assert_array_equal(one.stages[1].anchors, two.stages[1].anchors)


def test_poses_follow_their_stage(tmp_path, stages):
    found = align_stages(write_yaml(tmp_path / "p.yaml", *picks(0.0)), stages, CONFIG)
    pose = from_yaw(0.5, (3, 4, 1.6))
    moved = aligned_poses(
        {
            FragmentId("1", 1, 1): inverse(T_ANCHOR_STAGE) @ pose,
            FragmentId("1", 2, 1): pose,
        },
        found,
    )
    np.testing.assert_allclose(moved[FragmentId("1", 1, 1)], pose, atol=0.02)
    np.testing.assert_array_equal(moved[FragmentId("1", 2, 1)], pose)
    with pytest.raises(InputError, match="Stage 3 of Bldg1_Stage3_Spot1 is not aligned"):
        aligned_poses({FragmentId("1", 3, 1): pose}, found)


@given(bad=st.integers(0, 4), seed=st.integers(0, 50))
def test_a_bad_pick_is_named(tmp_path_factory, bad, seed):
    points, anchors = picks(0.02, seed)
    away = np.random.default_rng(seed).normal(size=3)
    points[bad] += 2.0 * away / np.linalg.norm(away)
    file = write_yaml(tmp_path_factory.mktemp("picks") / "picks.yaml", points, anchors)
    with pytest.raises(InputError, match=rf"pick {bad + 1} fits the others worst: pick it again"):
        align_stages(file, {1: points, 2: anchors}, CONFIG)


def test_a_doubtful_pick_is_warned_of(tmp_path, stages):
    points, anchors = picks(0.0)
    points[3] += (0.3, 0, 0)
    found = align_stages(write_yaml(tmp_path / "p.yaml", points, anchors), stages, CONFIG)
    assert any(w.startswith("Pick 4 of stage 1 misses") for w in found[1].warnings)
    assert found[1].residuals.argmax() == 3
    error = inverse(T_ANCHOR_STAGE) @ found[1].T_anchor_stage
    assert np.linalg.norm(transform_points(error, stages[1]) - stages[1], axis=1).max() < 0.03


def test_picks_that_do_not_determine_an_alignment(tmp_path):
    stages = {1: np.zeros((10, 3)), 2: np.zeros((10, 3))}
    file = tmp_path / "p.yaml"
    write_yaml(file, *picks(0.0, corners=CORNERS[:2]))
    with pytest.raises(InputError, match=r"Only 2 points are picked of stage 1 in .*p\.yaml"):
        align_stages(file, stages, CONFIG)
    line = np.outer((0.0, 1.0, 2.0, 5.0), (3.0, 1.0, 0.2))
    write_yaml(file, *picks(0.0, corners=line))
    with pytest.raises(InputError, match="of a line, about which the stage could turn"):
        align_stages(file, stages, CONFIG)
    points, anchors = picks(0.0)
    write_yaml(file, points * 1000, anchors)
    with pytest.raises(InputError, match=r"are 0\.001 times as far apart .* all in metres"):
        align_stages(file, stages, CONFIG)
    write_yaml(file, points, anchors)
    with pytest.raises(InputError, match="names stage 1, but there is no scan of it"):
        align_stages(file, {2: stages[2]}, CONFIG)


def test_icp_that_runs_away_is_not_believed(tmp_path, stages):
    strict = CONFIG.model_copy(update={"max_correction": 1e-4})
    points, anchors = picks(0.05)
    found = align_stages(write_yaml(tmp_path / "p.yaml", points, anchors), stages, strict)
    np.testing.assert_allclose(found[1].T_anchor_stage, fit_rigid(points, anchors), atol=1e-12)
    assert "which is not believed" in found[1].warnings[-1]
    elsewhere = {1: stages[1] + 1000.0, 2: stages[2]}
    found = align_stages(tmp_path / "p.yaml", elsewhere, CONFIG)
    assert "shows nothing of the anchor stage" in found[1].warnings[-1]
    assert np.isnan(found[1].rmse)


def test_scans_with_normals_are_taken_as_they_are(tmp_path, stages):
    scan = StageScan(stages[2], np.tile((0.0, 0.0, 1.0), (len(stages[2]), 1)))
    file = write_yaml(tmp_path / "p.yaml", CORNERS, CORNERS)
    found = align_stages(file, {1: scan, 2: scan}, CONFIG)
    np.testing.assert_allclose(found[1].T_anchor_stage, np.eye(4), atol=1e-9)


@given(seed=st.integers(0, 1000), count=st.integers(3, 8))
def test_the_fit_is_exact_without_noise_and_never_a_mirror(seed, count):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(count, 3)) * 5
    points[:, 2] *= seed % 2  # every other time all in a plane
    truth = exponential(rng.normal(size=6))
    np.testing.assert_allclose(fit_rigid(points, transform_points(truth, points)), truth, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a.yaml", "[1, 2", "is not valid YAML"),
        ("a.yaml", "anchor: 2", "does not hold picked points"),
        ("a.yaml", "anchor: two\nstages: {}", "'anchor' of .* must be the number of a stage"),
        ("a.yaml", "anchor: 2\nstages: {}", "holds no picked points"),
        ("a.yaml", "anchor: 2\nstages: {1: 3}", "must hold a list"),
        ("a.yaml", "anchor: 2\nstages: {1: [{point: [1, 2, 3]}]}", "Pick 1 of stage 1 of .* must"),
        (
            "a.yaml",
            "anchor: 2\nstages: {1: [{point: [1, .nan, 3], anchor: [1, 2, 3]}]}",
            "three finite numbers",
        ),
        (
            "a.yaml",
            "anchor: 2\nstages: {2: [{point: [1, 2, 3], anchor: [1, 2, 3]}]}",
            "which is the anchor: leave them out",
        ),
        ("a.csv", "x,y,z\n", "must begin with the line stage,x,y,z"),
        ("a.csv", "stage,x,y,z,anchor_stage,anchor_x,anchor_y,anchor_z\n", "holds no picked"),
        (
            "a.csv",
            "stage,x,y,z,anchor_stage,anchor_x,anchor_y,anchor_z\n1,2,3\n",
            "Line 2 of .* must have 8 columns, not 3",
        ),
        (
            "a.csv",
            "stage,x,y,z,anchor_stage,anchor_x,anchor_y,anchor_z\n"
            "1,1,1,1,2,1,1,1\n1,1,1,1,3,1,1,1\n",
            r"names 2 anchor stages \(2, 3\)",
        ),
    ],
)
def test_damaged_files_are_named(tmp_path, name, text, words):
    (tmp_path / name).write_text(text)
    with pytest.raises(FormatError, match=words):
        read_point_pairs(tmp_path / name)
    with pytest.raises(FormatError, match="Cannot read the picked points"):
        read_point_pairs(tmp_path / "nowhere.yaml")
