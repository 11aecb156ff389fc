"""Out into the layout of the NSS release and back again."""

import json
import math
import shutil

import numpy as np
import pytest
from floor_scan import make_floor
from hypothesis import given
from hypothesis import strategies as st

from nss_ros.config import GraphConfig, PairConfig, SplitConfig
from nss_ros.dataset.annotate import GraphKind, add_graphs, add_pairs, pair_sets
from nss_ros.dataset.annotation import (
    PairAnnotation,
    fragment_of,
    pair_table,
    read_annotations,
    write_annotations,
)
from nss_ros.dataset.bag_export import ground_truth_graph
from nss_ros.dataset.challenge import fragment_ids
from nss_ros.dataset.folder import DatasetFolder, write_panorama
from nss_ros.dataset.pairs import read_pairs
from nss_ros.dataset.ply import read_columns, write_ply
from nss_ros.dataset.refinement import (
    RefinedPair,
    read_refined,
    refined_transforms,
    write_refined,
)
from nss_ros.dataset.release import is_release, read_release
from nss_ros.dataset.release_export import export_release
from nss_ros.dataset.release_import import as_challenge, as_dataset
from nss_ros.dataset.splits import SETS, Split
from nss_ros.errors import FormatError, InputError
from nss_ros.fragment import FragmentId, FragmentPair, voxelize
from nss_ros.geometry import exponential, relative, transform_points

GRAPHS = GraphConfig(min_component=4)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """Twelve fragments in two stages, with pairs, splits and panoramas."""
    folder = tmp_path_factory.mktemp("release") / "dataset"
    make_floor(folder, spots=6)
    made = DatasetFolder(folder)
    add_pairs(made, PairConfig(), SplitConfig(validation_share=0.3), 0, workers=1)
    (folder / "panorama").mkdir()
    for i, id_ in enumerate(made.fragment_ids()):
        write_panorama(folder, id_, np.arange(128, dtype=np.uint16).reshape(8, 16) * 300 + i)
    return made


@pytest.fixture(scope="module")
def exported(dataset):
    output = dataset.path.with_name("release")
    export_release(dataset, output, GRAPHS)
    return output


@pytest.fixture
def release(exported, tmp_path):
    """A copy that a test may damage."""
    copy = tmp_path / "copy"
    for file in exported.rglob("*"):
        if file.is_file():
            target = copy / file.relative_to(exported)
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(file.read_bytes())
    return copy


def same_pairs(one, other):
    assert one.pairs == other.pairs
    for name in (
        "overlap_ratio", "reverse_overlap_ratio", "temporal_change", "source_complexity",
        "target_complexity", "selected",
    ):  # fmt: skip
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)


def test_the_layout_is_that_of_the_release(dataset, exported):
    assert is_release(exported)
    assert not is_release(dataset.path)
    ids = [str(id_) for id_ in dataset.fragment_ids()]
    assert sorted(p.stem for p in (exported / "pointclouds").iterdir()) == sorted(ids)
    assert sorted(p.stem for p in (exported / "panoramas").iterdir()) == sorted(ids)
    for split in ("original", "cross_stage"):
        for name in SETS:
            for kind in ("annotations", "annotations_multiway"):
                assert isinstance(
                    json.loads((exported / kind / split / f"{name}.json").read_text()), list
                )
    pair = json.loads((exported / "annotations" / "original" / "train.json").read_text())[0]
    assert {"source", "target", "tsfm", "overlap", "temporal_change", "same_stage"} <= set(pair)
    graph = json.loads((exported / "annotations_multiway" / "original" / "train.json").read_text())[
        0
    ]
    assert set(graph) == {"name", "nodes", "edges"}
    assert set(graph["nodes"][0]) == {
        "id", "name", "tsfm", "building", "stage", "spot", "points"
    }  # fmt: skip
    assert {"source", "target", "tsfm", "overlap", "same_stage"} <= set(graph["edges"][0])
    assert graph["nodes"][0]["stage"] == "1"


def test_a_transform_maps_the_source_onto_the_target(dataset, exported):
    poses = dataset.poses()
    for each in read_annotations(exported / "annotations" / "original" / "train.json"):
        T_target_source = relative(poses[each.pair.source], poses[each.pair.target])
        np.testing.assert_allclose(each.T_target_source, T_target_source, rtol=0, atol=1e-9)
        here = transform_points(poses[each.pair.source], np.eye(3))
        there = transform_points(poses[each.pair.target] @ each.T_target_source, np.eye(3))
        np.testing.assert_allclose(here, there, rtol=0, atol=1e-9)


def test_clouds_are_voxelised_as_the_release_is(dataset, exported):
    for id_ in dataset.fragment_ids()[:3]:
        columns = read_columns(exported / "pointclouds" / f"{id_}.ply")
        points = np.column_stack([columns[axis] for axis in "xyz"])
        np.testing.assert_array_equal(points, voxelize(dataset.columns(id_).points, 0.075))
        assert set(columns) == {"x", "y", "z", "nx", "ny", "nz"}


def test_what_comes_back_is_what_went_out(dataset, exported, tmp_path):
    back, left_out = as_dataset(read_release(exported), tmp_path / "back")
    assert left_out == ()
    assert back.manifest.complete
    assert back.manifest.seed == dataset.manifest.seed
    assert back.fragment_ids() == dataset.fragment_ids()
    for id_, pose in dataset.poses().items():
        np.testing.assert_array_equal(back.poses()[id_], pose)
        np.testing.assert_array_equal(
            back.fragment(id_).points, voxelize(dataset.fragment(id_).points, 0.075)
        )
        np.testing.assert_array_equal(back.panorama(id_), dataset.panorama(id_))
    for split in ("original", "cross_stage"):
        for name in SETS:
            file = f"splits/{split}/{name}.csv"
            same_pairs(read_pairs(back.path / file), read_pairs(dataset.path / file))
            same_pairs(pair_sets(back, Split(split))[name], read_pairs(dataset.path / file))
    whole = read_pairs(dataset.path / "pairs.csv")
    table = read_pairs(back.path / "pairs.csv")
    same_pairs(table.take(table.selected), whole.take(whole.selected))
    # What was exported once is exported again, byte for byte.
    export_release(back, tmp_path / "again", GRAPHS)
    files = {p.relative_to(exported): p.read_bytes() for p in exported.rglob("*") if p.is_file()}
    for path, content in files.items():
        if path.name != "nss_ros.json":  # which now says that the pairs were imported
            assert (tmp_path / "again" / path).read_bytes() == content, path


def test_graphs_that_were_made_are_exported(dataset, tmp_path):
    back, _ = as_dataset(read_release(_exported(dataset, tmp_path / "one")), tmp_path / "back")
    assert list((back.path / "multiway_graph" / "original" / "train").glob("*.json"))
    add_graphs(back, GraphKind.MULTIWAY, Split.ORIGINAL, GraphConfig(min_component=3), 0)
    export_release(back, tmp_path / "two", GraphConfig(min_component=50))
    release = read_release(tmp_path / "two")
    assert release.graphs["original"]["train"]
    assert min(len(graph.nodes) for graph in release.graphs["original"]["train"]) >= 3


def _exported(dataset, path):
    export_release(dataset, path, GRAPHS)
    return path


def test_refined_ground_truth_goes_out_and_comes_back(dataset, tmp_path):
    shutil.copytree(dataset.path, tmp_path / "refined")
    refined = DatasetFolder(tmp_path / "refined")
    poses = refined.poses()
    table = read_pairs(refined.path / "splits" / "original" / "train.csv")
    pair, other = table.take(~table.same_stage).pairs[:2]
    truth, kept = (relative(poses[p.source], poses[p.target]) for p in (pair, other))
    moved = truth @ exponential(np.array([0.01, -0.02, 0.0, 0.0, 0.0, 0.003]))
    rest = {"rotation": 0.003, "rmse": 0.01, "correspondences": 900, "deviation": 0.001}
    write_refined(
        refined.path,
        {
            pair: RefinedPair(moved, reason="", translation=0.022, **rest),
            other: RefinedPair(kept, reason="not well determined", translation=0.0, **rest),
        },
    )
    (graph,) = add_graphs(refined, GraphKind.MULTIWAY, None, GRAPHS, 0).graphs["all"]
    ids = fragment_ids(graph)
    edges = {FragmentPair(ids[e.source], ids[e.target]): e.transform for e in graph.edges}
    np.testing.assert_array_equal(edges[pair], moved)
    np.testing.assert_allclose(edges[other], kept, rtol=0, atol=1e-12)
    in_bag = ground_truth_graph(refined, "1", table)
    (edge,) = [edge for edge in in_bag.edges if edge.pair == pair]
    np.testing.assert_array_equal(edge.T_target_source, moved)
    export_release(refined, tmp_path / "out", GRAPHS)
    release = read_release(tmp_path / "out")
    told = {each.pair: each.T_target_source for each in release.annotations["original"]["train"]}
    np.testing.assert_array_equal(told[pair], moved)
    back, _ = as_dataset(release, tmp_path / "back")
    ((again, found),) = read_refined(back.path).items()
    assert again == pair
    np.testing.assert_array_equal(found.T_target_source, moved)
    assert found.accepted
    assert found.translation == pytest.approx(0.022, abs=0.005)
    assert np.isnan(found.rmse)
    np.testing.assert_allclose(
        refined_transforms(back.path)[FragmentPair(pair.target, pair.source)] @ moved,
        np.eye(4),
        atol=1e-12,
    )


def test_a_bag_takes_the_pairs_of_a_split(dataset, exported):
    release = read_release(exported)
    taken = as_challenge(release, "cross_stage", ["test"])
    want = read_pairs(dataset.path / "splits" / "cross_stage" / "test.csv")
    assert set(taken.pairs) == set(want.pairs)
    (truth,) = taken.ground_truth
    assert truth.name == "Bldg1_cross_stage"
    poses = dataset.poses()
    for node in truth.nodes:
        np.testing.assert_allclose(node.T_map_fragment, poses[node.id], rtol=0, atol=1e-9)
    for edge in truth.edges:
        expected = relative(poses[edge.pair.source], poses[edge.pair.target])
        np.testing.assert_allclose(edge.T_target_source, expected, rtol=0, atol=1e-9)
    whole = as_challenge(release)
    assert len(whole.pairs) == sum(len(part) for part in release.annotations["original"].values())
    multiway = as_challenge(release, "original", multiway=True)
    assert {graph.name for graph in multiway.graphs} == {
        graph.name for part in release.graphs["original"].values() for graph in part
    }


def test_a_release_of_others_has_no_extras(dataset, release, tmp_path):
    """Names of 2025, normals missing, no poses: they follow from the relative transforms."""
    for name in ("poses.jsonl", "nss_ros.json"):
        (release / name).unlink()
    for file in (release / "annotations_multiway").rglob("*.json"):
        file.unlink()
    (release / "annotations").rename(release / "annotation")
    for file in (release / "annotation").rglob("*.json"):
        pairs = json.loads(file.read_text())
        for pair in pairs:
            pair["relative_transform"] = pair.pop("tsfm")
            pair["overlap_ratio"] = pair.pop("overlap")
            for extra in ("reverse_overlap", "source_complexity", "target_complexity"):
                del pair[extra]
        file.write_text(json.dumps(pairs))
    for file in (release / "pointclouds").iterdir():
        columns = read_columns(file)
        write_ply(file.with_suffix(".450.ply"), {axis: columns[axis] for axis in "xyz"})
        file.unlink()
    back, left_out = as_dataset(read_release(release), tmp_path / "back", gravity_aligned=True)
    poses, found = dataset.poses(), back.poses()
    assert len(found) + (int(left_out[0].split()[2]) if left_out else 0) == len(poses)
    first = next(iter(found))
    move = poses[first] @ np.linalg.inv(found[first])
    for id_, pose in found.items():
        np.testing.assert_allclose(move @ pose, poses[id_], rtol=0, atol=1e-9)
    columns = back.columns(first)
    lengths = np.linalg.norm(columns.normals, axis=1)
    np.testing.assert_allclose(lengths, 1, atol=1e-5)
    assert (np.einsum("ni,ni->n", columns.points, columns.normals) <= 1e-4).all()
    table = read_pairs(back.path / "pairs.csv")
    assert np.isnan(table.reverse_overlap_ratio).all()
    assert back.manifest.gravity_aligned
    assert pair_sets(back, Split.ORIGINAL)["train"].pairs


def test_poses_of_graphs_count_without_our_own_file(dataset, release):
    (release / "poses.jsonl").unlink()
    poses = read_release(release).poses
    assert poses
    for id_, pose in poses.items():
        np.testing.assert_allclose(pose, dataset.poses()[id_], rtol=0, atol=1e-9)


def twice(pairs):
    pairs.append(dict(pairs[0], source=pairs[0]["target"], target=pairs[0]["source"]))


PAIR_DAMAGE = {
    "id": lambda pairs: pairs[0].update(source="Room 5"),
    "unknown id": lambda pairs: pairs[0].update(source="Bldg9_Stage1_Spot1.ply"),
    "itself": lambda pairs: pairs[0].update(target=pairs[0]["source"]),
    "twice": twice,
    "scaled": lambda pairs: pairs[0]["tsfm"][0].__setitem__(0, 7),
    "NaN": lambda pairs: pairs[0]["tsfm"][0].__setitem__(3, math.nan),
    "overlap": lambda pairs: pairs[0].update(overlap=1.5),
    "no overlap": lambda pairs: pairs[0].pop("overlap"),
}
TRAIN, GRAPH = "annotations/original/train.json", "annotations_multiway/original/train.json"
FILE_DAMAGE = {
    "truncated": lambda folder: (folder / TRAIN).write_text((folder / TRAIN).read_text()[:300]),
    "not a list": lambda folder: (folder / TRAIN).write_text("{}"),
    "cloud": lambda folder: (folder / "pointclouds" / "Bldg1_Stage1_Spot1.ply").unlink(),
    "clouds": lambda folder: (folder / "pointclouds").rename(folder / "clouds"),
    "manifest": lambda folder: (folder / "nss_ros.json").write_text("{}"),
    "edge": lambda folder: (folder / GRAPH).write_text(
        (folder / GRAPH).read_text().replace('"target": ', '"target": 999', 1)
    ),
    "graphs": lambda folder: (folder / GRAPH).write_text("[{]"),
}


def damage(folder, what):
    if what in FILE_DAMAGE:
        FILE_DAMAGE[what](folder)
        return
    pairs = json.loads((folder / TRAIN).read_text())
    PAIR_DAMAGE[what](pairs)
    (folder / TRAIN).write_text(json.dumps(pairs))


@pytest.mark.parametrize(
    ("what", "message"),
    [
        ("truncated", r"train\.json is not valid JSON, it may be truncated"),
        ("not a list", r"train\.json is not a list"),
        ("id", r"'source' of pair 1 of .*train\.json .*'Room 5' is not a fragment id"),
        ("unknown id", r"Bldg9_Stage1_Spot1\.ply is missing"),
        ("itself", "pair 1 of .* are one fragment"),
        ("twice", r"train\.json .*occurs twice"),
        ("scaled", "'tsfm' of pair 1 .* is not rigid"),
        ("NaN", "'tsfm' of pair 1 .* is not rigid"),
        ("overlap", "'overlap' of pair 1 .* from 0 to 1, not 1.5"),
        ("no overlap", "no 'overlap' in pair 1"),
        ("cloud", r"Bldg1_Stage1_Spot1\.ply is missing"),
        ("clouds", "no folder 'pointclouds'"),
        ("manifest", r"nss_ros\.json is not a manifest"),
        ("edge", r"names the node 999\d+, which the graph does not have"),
        ("graphs", r"train\.json is not valid JSON"),
    ],
)
def test_what_is_damaged_is_named(release, what, message):
    damage(release, what)
    with pytest.raises((FormatError, InputError), match=message) as caught:
        read_release(release)
    assert str(caught.value).count("\n") == 0


def test_points_that_are_not_finite_are_refused(release, tmp_path):
    file = release / "pointclouds" / "Bldg1_Stage1_Spot2.ply"
    columns = read_columns(file)
    columns["y"][5] = np.nan
    write_ply(file, columns)
    with pytest.raises(FormatError, match=r"Spot2\.ply holds 1 points that are not finite"):
        as_dataset(read_release(release), tmp_path / "back")
    # What was written stays, and the same call completes it once the file is mended.
    columns["y"][5] = 0.0
    write_ply(file, columns)
    back, _ = as_dataset(read_release(release), tmp_path / "back")
    assert back.manifest.complete


def test_an_export_needs_pairs_and_an_empty_folder(dataset, exported, tmp_path):
    with pytest.raises(InputError, match="exists already"):
        export_release(dataset, exported, GRAPHS)
    make_floor(tmp_path / "bare", spots=2)
    with pytest.raises(InputError, match="no splits yet: run 'nss pairs"):
        export_release(DatasetFolder(tmp_path / "bare"), tmp_path / "out", GRAPHS)
    with pytest.raises(InputError, match="There is no folder"):
        read_release(tmp_path / "none")
    with pytest.raises(InputError, match="no annotated pairs of the split 'cross_area'"):
        as_challenge(read_release(exported), "cross_area")


ratios = st.one_of(st.just(math.nan), st.floats(0, 1))
ids = st.builds(
    FragmentId, st.sampled_from(["1", "A.b"]), st.integers(1, 9), st.integers(0, 10**9 - 1)
)
annotations = st.builds(
    lambda pair, twist, overlap, figures: PairAnnotation(
        FragmentPair(*pair), exponential(np.array(twist)), overlap, *figures
    ),
    st.lists(ids, min_size=2, max_size=2, unique=True),
    st.lists(st.floats(-3, 3), min_size=6, max_size=6),
    st.floats(0, 1),
    st.lists(ratios, min_size=4, max_size=4),
)


@given(st.lists(annotations, max_size=4))
def test_annotations_come_back_to_the_last_digit(tmp_path_factory, pairs):
    path = tmp_path_factory.mktemp("annotations") / "set.json"
    write_annotations(path, pairs)
    again = read_annotations(path)
    assert [each.pair for each in again] == [each.pair for each in pairs]
    for one, other in zip(pairs, again, strict=True):
        np.testing.assert_array_equal(one.T_target_source, other.T_target_source)
    if len({frozenset((a.pair.source, a.pair.target)) for a in pairs}) == len(pairs):
        same_pairs(pair_table(again), pair_table(pairs))


@given(ids)
def test_names_of_clouds_tell_the_fragment(id_):
    for ending in ("", ".ply", ".450.ply"):
        assert fragment_of(f"{id_}{ending}") == id_
