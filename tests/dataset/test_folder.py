import json
import shutil

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from nss_ros.dataset.folder import GONE, NEW, DatasetFolder, FragmentColumns
from nss_ros.dataset.manifest import Manifest
from nss_ros.dataset.pose_file import read_poses, write_poses
from nss_ros.dataset.site_record import ElementRecord, SiteRecord
from nss_ros.dataset.writer import DatasetWriter
from nss_ros.errors import FormatError, InputError
from nss_ros.fragment import FragmentId
from nss_ros.geometry import exponential

MANIFEST = Manifest(seed=3, simulation={"voxel_size": 0.075, "rig": {"tilt": 0.5}})
SITES = [
    SiteRecord(
        area=area,
        stages=2,
        stage_names=["shell", "finishing"],
        extent=(0.0, 0.0, 20.0, 10.0),
        floor_height=0.0,
        elements=[
            ElementRecord(index=0, kind="slab", name="", material="matt", stages=[1, 2]),
            ElementRecord(index=1, kind="pallet", name="P1", material="dark", stages=[1]),
        ],
    )
    for area in ("1", "2")
]


def scan(fragment):
    rng = np.random.default_rng((fragment.area == "2", fragment.stage, fragment.spot))
    normals = rng.normal(size=(40, 3)).astype(np.float32)
    elements = rng.integers(0, 2, 40).astype(np.int32)
    gone = elements == 1
    columns = FragmentColumns(
        points=rng.normal(size=(40, 3)).astype(np.float32),
        normals=normals,
        elements=elements,
        change=np.where(gone, GONE if fragment.stage == 1 else NEW, 0).astype(np.uint8),
    )
    panorama = rng.integers(0, 65536, (8, 16)).astype(np.uint16)
    return exponential(rng.normal(size=6)), columns, panorama


def ids(area):
    return [FragmentId(area, stage, spot) for stage in (1, 2) for spot in (1, 2, 10)]


def make(path, stop_after=None, manifest=MANIFEST):
    """Make the dataset, or as much of it as `stop_after` fragments; return how many it made."""
    writer = DatasetWriter(path, manifest, panoramas=True)
    made = 0
    for site in SITES:
        if writer.area_complete(site.area):
            continue
        writer.begin_area(site, {"made": "by hand", "area": site.area})
        for fragment in ids(site.area):
            if fragment in writer.done(site.area):
                continue
            if made == stop_after:
                return made
            writer.append(fragment, *scan(fragment))
            made += 1
        writer.finish_area(site.area)
    writer.finish()
    return made


def content(path):
    return {
        str(file.relative_to(path)): file.read_bytes() for file in path.rglob("*") if file.is_file()
    }


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    path = tmp_path_factory.mktemp("datasets") / "whole"
    make(path)
    return path


def test_what_is_written_is_read(whole):
    dataset = DatasetFolder(whole)
    assert dataset.manifest.complete
    assert dataset.areas() == ["1", "2"]
    assert dataset.fragment_ids() == ids("1") + ids("2")
    assert dataset.fragment_ids("2") == ids("2")
    for fragment in dataset.fragment_ids():
        pose, columns, panorama = scan(fragment)
        read = dataset.columns(fragment)
        np.testing.assert_array_equal(dataset.poses()[fragment], pose)
        for name in ("points", "normals", "elements", "change"):
            np.testing.assert_array_equal(getattr(read, name), getattr(columns, name))
        np.testing.assert_array_equal(dataset.panorama(fragment), panorama)
        assert dataset.fragment(fragment).gravity_aligned
    assert [stage.fragments for stage in dataset.manifest.areas["1"].stages] == [3, 3]
    assert dataset.manifest.areas["2"].source == {"made": "by hand", "area": "2"}
    assert dataset.site("1") == SITES[0]


def test_change_against_another_stage(whole):
    dataset = DatasetFolder(whole)
    first = FragmentId("1", 1, 1)
    np.testing.assert_array_equal(dataset.changed(first, 2), dataset.columns(first).change == GONE)
    assert not dataset.changed(first, 1).any()


@settings(max_examples=12, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(stops=st.lists(st.integers(0, 9), max_size=3), cut=st.integers(0, 80))
def test_an_interrupted_run_ends_in_the_same_bytes(tmp_path_factory, whole, stops, cut):
    path = tmp_path_factory.mktemp("cut") / "dataset"
    for stop in stops:
        make(path, stop)
        poses = path / "poses.jsonl"
        poses.write_bytes(poses.read_bytes()[: len(poses.read_bytes()) - cut])
    make(path)
    assert content(path) == content(whole)
    assert make(path) == 0


def test_only_what_is_missing_is_made_again(tmp_path, whole):
    path = tmp_path / "dataset"
    shutil.copytree(whole, path)
    (path / "point_cloud/Bldg1_Stage2_Spot1.ply").unlink()
    (path / "panorama/Bldg2_Stage1_Spot10.png").unlink()
    with pytest.raises(FormatError, match=r"Spot1\.ply is missing: make it again"):
        DatasetFolder(path).columns(FragmentId("1", 2, 1))
    assert make(path) == 2
    assert content(path) == content(whole)


def test_an_unfinished_dataset_can_be_read(tmp_path):
    make(tmp_path / "a", stop_after=4)
    dataset = DatasetFolder(tmp_path / "a")
    assert not dataset.manifest.complete
    assert dataset.fragment_ids() == ids("1")[:4]
    assert dataset.manifest.areas["1"].stages[0].fragments is None


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"seed": 4}, "seed = 3, not 4"),
        (
            {"simulation": {"voxel_size": 0.075, "rig": {"tilt": 1.5}}},
            r"simulation\.rig\.tilt = 0\.5, not 1\.5",
        ),
        ({"versions": {"numpy": "9"}}, r"versions\.numpy = null, not \"9\""),
        ({"labels": False}, "labels = true, not false"),
    ],
)
def test_other_settings_are_refused(whole, change, words):
    before = content(whole)
    with pytest.raises(InputError, match=f"was begun with {words}: finish it"):
        DatasetWriter(whole, MANIFEST.model_copy(update=change), panoramas=True)
    assert content(whole) == before


def test_where_no_area_was_begun_other_settings_are_welcome(tmp_path):
    DatasetWriter(tmp_path / "a", MANIFEST, panoramas=True)  # its first site could not be built
    other = MANIFEST.model_copy(update={"seed": 4, "versions": {"numpy": "9"}})
    assert make(tmp_path / "a", manifest=other) == 12
    assert make(tmp_path / "b", manifest=other) == 12
    assert content(tmp_path / "a") == content(tmp_path / "b")


def test_another_site_is_refused(tmp_path):
    make(tmp_path / "a", stop_after=2)
    writer = DatasetWriter(tmp_path / "a", MANIFEST, panoramas=True)
    with pytest.raises(InputError, match=r"Area 1 of .* was begun with another site"):
        writer.begin_area(SITES[0], {"made": "otherwise"})


def test_a_folder_with_something_else_is_left_alone(tmp_path):
    (tmp_path / "thesis.txt").write_text("precious")
    with pytest.raises(InputError, match="exists and is not a dataset"):
        DatasetWriter(tmp_path, MANIFEST)
    assert [file.name for file in tmp_path.iterdir()] == ["thesis.txt"]
    with pytest.raises(InputError, match="exists and is not a dataset"):
        DatasetWriter(tmp_path / "thesis.txt", MANIFEST)


def test_what_is_not_there_is_named(tmp_path, whole):
    dataset = DatasetFolder(whole)
    with pytest.raises(InputError, match="has no fragment Bldg9_Stage1_Spot1"):
        dataset.fragment(FragmentId("9", 1, 1))
    with pytest.raises(InputError, match="has no area '9': its areas are 1, 2"):
        dataset.site("9")
    with pytest.raises(FormatError, match="is not a dataset: it has no readable manifest"):
        DatasetFolder(tmp_path)


@pytest.mark.parametrize(
    ("text", "words"),
    [("{", "Invalid JSON"), ("{}", "nss_ros: seed: Field required"), ('{"nss_dataset": 2}', "1")],
)
def test_a_damaged_manifest_is_named(tmp_path, text, words):
    (tmp_path / "manifest.json").write_text(text)
    with pytest.raises(FormatError, match=rf"manifest\.json is not the manifest .*{words}"):
        DatasetFolder(tmp_path)


@pytest.mark.parametrize(
    "line",
    [
        "{",
        "[]",
        '{"id": "spot 3", "T_map_fragment": []}',
        json.dumps({"id": "Bldg1_Stage1_Spot1", "T_map_fragment": np.zeros((4, 4)).tolist()}),
        json.dumps({"id": "Bldg1_Stage1_Spot1", "T_map_fragment": "x"}),
    ],
)
def test_a_damaged_pose_is_named(tmp_path, line):
    path = tmp_path / "poses.jsonl"
    write_poses(path, {FragmentId("1", 1, 2): np.eye(4)})
    path.write_text(path.read_text() + line + "\n")
    with pytest.raises(FormatError, match=r"poses\.jsonl, line 2 is not a pose"):
        read_poses(path)


def test_lost_poses_are_noticed(tmp_path, whole):
    path = tmp_path / "dataset"
    shutil.copytree(whole, path)
    poses = path / "poses.jsonl"
    poses.write_bytes(poses.read_bytes()[:-1])
    with pytest.raises(FormatError, match=r"poses\.jsonl holds 11 poses, but the manifest says 12"):
        DatasetFolder(path).poses()
    assert make(path) == 1
    assert content(path) == content(whole)


def test_a_damaged_panorama_is_named(tmp_path, whole):
    path = tmp_path / "dataset"
    shutil.copytree(whole, path)
    file = path / "panorama/Bldg1_Stage1_Spot1.png"
    for damage in (b"no image", file.read_bytes()[:60]):
        file.write_bytes(damage)
        with pytest.raises(FormatError, match=r"Spot1\.png"):
            DatasetFolder(path).panorama(FragmentId("1", 1, 1))
