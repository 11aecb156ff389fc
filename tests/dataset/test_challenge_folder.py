import json

import numpy as np
import pytest

from nss_ros.dataset.challenge_folder import PairChoice, read_folder, read_fragment
from nss_ros.dataset.ply import write_ply
from nss_ros.errors import FormatError, InputError
from nss_ros.fragment import FragmentId, FragmentPair
from nss_ros.geometry import from_yaw

SPOTS = [FragmentId("1", 1, spot) for spot in range(4)]


def graph(name, spots, edges):
    nodes = [
        {"id": i, "name": f"{SPOTS[spot]}.ply", "global_transform": from_yaw(0, (i, 0, 0)).tolist()}
        for i, spot in enumerate(spots)
    ]
    if edges is None:
        return {"name": name, "nodes": nodes}
    return {"name": name, "nodes": nodes, "edges": [
        {"source_id": s, "target_id": t, "relative_transform": np.eye(4).tolist()}
        for s, t in edges
    ]}  # fmt: skip


@pytest.fixture
def folder(tmp_path):
    """Two graphs that share spot 1 and 2, and a hidden one without edges."""
    (tmp_path / "point_cloud").mkdir()
    for spot in SPOTS:
        points = np.random.default_rng(spot.spot).normal(size=(20, 3))
        write_ply(
            tmp_path / "point_cloud" / f"{spot}.ply",
            {axis: points[:, i] for i, axis in enumerate("xyz")},
        )
    for split, content in (
        ("train", graph("Bldg1_Graph1", [0, 1, 2], [(0, 1), (2, 1)])),
        ("val", [graph("Bldg1_Graph2", [1, 2, 3], [(0, 1), (1, 2)])]),
        ("test", graph("Bldg1_Graph3", [3, 1, 0], None)),
    ):
        place = tmp_path / "pose_graph" / split
        place.mkdir(parents=True)
        (place / f"{split}.json").write_text(json.dumps(content))
    return tmp_path


def pairs(*numbers):
    return {FragmentPair(SPOTS[s], SPOTS[t]) for s, t in numbers}


def test_graphs_share_fragments_and_pairs(folder):
    challenge = read_folder(folder)
    assert list(challenge.point_files) == SPOTS
    assert [g.name for g in challenge.ground_truth] == [
        "Bldg1_Graph3", "Bldg1_Graph1", "Bldg1_Graph2"
    ]  # fmt: skip
    # Graph 3 asks for (0, 1), (0, 3), (1, 3); the others' (2, 1) and (1, 2) are one pair.
    assert set(challenge.pairs) == pairs((0, 1), (0, 3), (1, 3), (2, 1), (2, 3))


@pytest.mark.parametrize("pattern", ["Bldg1_Graph2", "*Graph2", "val", "val.json", "*/val/*"])
def test_graphs_are_chosen_by_name_or_file(folder, pattern):
    challenge = read_folder(folder, pattern)
    assert [g.name for g in challenge.graphs] == ["Bldg1_Graph2"]
    assert set(challenge.pairs) == pairs((1, 2), (2, 3))
    assert list(challenge.point_files) == SPOTS[1:]


def test_choice_of_pairs(folder):
    assert set(read_folder(folder, "*Graph1", PairChoice.ALL).pairs) == pairs(
        (0, 1), (0, 2), (1, 2)
    )
    assert read_folder(folder, "*Graph3", PairChoice.EDGES).pairs == ()


@pytest.mark.parametrize("name", ["pointclouds", "."])
def test_other_places_of_point_clouds(folder, name):
    for file in (folder / "point_cloud").iterdir():
        (folder / name).mkdir(exist_ok=True)
        file.rename(folder / name / file.name)
    assert len(read_folder(folder).point_files) == 4


def test_files_that_were_not_chosen_do_not_matter(folder):
    (folder / "pose_graph" / "notes.json").write_text('{"hello": 1}')
    assert len(read_folder(folder, "Bldg1_Graph*").graphs) == 3
    with pytest.raises(FormatError, match=r"notes\.json is not a pose graph"):
        read_folder(folder)


def test_what_is_missing_is_named(folder, tmp_path):
    with pytest.raises(InputError, match="There is no folder"):
        read_folder(folder / "nowhere")
    with pytest.raises(InputError, match=r"matches 'Bldg9': its files are pose_graph/test"):
        read_folder(folder, "Bldg9")
    (folder / "point_cloud" / f"{SPOTS[3]}.ply").unlink()
    with pytest.raises(FormatError, match=r"Spot3\.ply of node 0 .*test\.json is missing"):
        read_folder(folder)
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(InputError, match="holds no pose graph"):
        read_folder(empty)


def test_a_graph_name_must_occur_once(folder):
    file = folder / "pose_graph" / "again.json"
    file.write_text(json.dumps(graph("Bldg1_Graph1", [0, 1], None)))
    with pytest.raises(FormatError, match=r"Bldg1_Graph1 occurs in .*again\.json and in "):
        read_folder(folder)


def test_non_finite_points_are_left_out(tmp_path):
    points = np.array([[0, 0, 0], [np.nan, 0, 0], [1, np.inf, 2], [1, 2, 1e300]])
    write_ply(tmp_path / "a.ply", {axis: points[:, i] for i, axis in enumerate("xyz")})
    fragment, dropped = read_fragment(SPOTS[0], tmp_path / "a.ply", gravity_aligned=True)
    np.testing.assert_array_equal(fragment.points, [[0, 0, 0]])
    assert dropped == 3
    write_ply(tmp_path / "a.ply", {axis: points[1:2, i] for i, axis in enumerate("xyz")})
    with pytest.raises(FormatError, match=r"a\.ply holds no finite point"):
        read_fragment(SPOTS[0], tmp_path / "a.ply", gravity_aligned=False)


def test_a_cloud_too_far_from_its_origin_is_refused(tmp_path):
    points = np.random.default_rng(0).uniform(-4, 4, (50, 3))
    for offset in (0.0, 4e4):
        write_ply(tmp_path / "a.ply", dict(zip("xyz", (points + offset).T, strict=True)))
        assert read_fragment(SPOTS[0], tmp_path / "a.ply", gravity_aligned=True)[1] == 0
    write_ply(tmp_path / "a.ply", dict(zip("xyz", (points + np.array([5e5, 0, 0])).T, strict=True)))
    with pytest.raises(FormatError, match=r"a\.ply lies 500 km .* keeps 3\.1 cm only: subtract"):
        read_fragment(SPOTS[0], tmp_path / "a.ply", gravity_aligned=True)


@pytest.mark.parametrize(("factor", "unit"), [(100, "centimetres"), (1000, "millimetres")])
def test_a_cloud_that_is_not_in_metres_is_refused(tmp_path, factor, unit):
    points = np.random.default_rng(0).uniform(-4, 4, (500, 3)) * factor
    write_ply(tmp_path / "a.ply", dict(zip("xyz", points.T, strict=True)))
    with pytest.raises(FormatError, match=rf"a\.ply lies .* look like {unit}\. Scale"):
        read_fragment(SPOTS[0], tmp_path / "a.ply", gravity_aligned=True)
    write_ply(tmp_path / "a.ply", dict(zip("xyz", (points * 10 / factor).T, strict=True)))
    assert read_fragment(SPOTS[0], tmp_path / "a.ply", gravity_aligned=True)[1] == 0
