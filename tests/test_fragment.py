import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from nss_ros.errors import InputError
from nss_ros.fragment import FragmentId, FragmentPair, clean_points, voxelize

ids = st.builds(
    FragmentId,
    st.from_regex(r"[A-Za-z0-9]+", fullmatch=True).filter(str.isascii),
    st.integers(0, 99),
    st.integers(0, 9999),
)


@given(ids)
def test_an_id_survives_its_text(id_):
    assert FragmentId.parse(str(id_)) == id_
    assert FragmentId.parse(f"{id_}.ply") == id_


@pytest.mark.parametrize(
    "text",
    [
        "",
        "Bldg1",
        "Bldg1_Stage_Spot2",
        "Bldg1_Stage-1_Spot2",
        "x.ply",
        "Bldg1_Stage1_Spot4294967296",
    ],
)
def test_what_is_no_id_is_refused_by_name(text):
    with pytest.raises(InputError, match=f"'{text}' is not a fragment id"):
        FragmentId.parse(text)


def test_ids_are_ordered_by_number_not_by_text():
    assert FragmentId("1", 2, 10) > FragmentId("1", 2, 9)


def test_same_stage_means_same_area_too():
    assert FragmentPair(FragmentId("1", 1, 0), FragmentId("1", 1, 1)).same_stage
    assert not FragmentPair(FragmentId("1", 1, 0), FragmentId("2", 1, 1)).same_stage
    assert not FragmentPair(FragmentId("1", 1, 0), FragmentId("1", 2, 0)).same_stage


def test_points_that_are_not_finite_are_dropped():
    points = [[0, 0, 0], [np.nan, 0, 0], [0, np.inf, 0], [1, 2, 3]]
    assert clean_points(points).tolist() == [[0, 0, 0], [1, 2, 3]]


@pytest.mark.parametrize("points", [[1, 2, 3], [[1, 2]], [["a", "b", "c"]]])
def test_arrays_that_are_no_cloud_are_refused(points):
    with pytest.raises(InputError, match="point cloud"):
        clean_points(points)


clouds = arrays(
    np.float32, st.tuples(st.integers(1, 60), st.just(3)), elements=st.floats(-50, 50, width=32)
)


@given(clouds, st.sampled_from([0.05, 0.3, 2.0]))
def test_voxels_hold_the_mean_of_their_points(points, size):
    cells = np.floor(points / size).astype(int)
    expected = [
        points[(cells == cell).all(axis=1)].mean(axis=0, dtype=float)
        for cell in np.unique(cells, axis=0)
    ]
    np.testing.assert_allclose(voxelize(points, size), expected, atol=1e-4)


@given(clouds, st.randoms(use_true_random=False))
def test_voxels_do_not_depend_on_the_order_of_points(points, random):
    order = list(range(len(points)))
    random.shuffle(order)
    np.testing.assert_allclose(voxelize(points[order], 0.5), voxelize(points, 0.5), atol=1e-5)


def test_no_points_give_no_voxels():
    assert voxelize(np.zeros((0, 3), np.float32), 0.1).shape == (0, 3)


def test_a_voxel_needs_a_size():
    with pytest.raises(InputError, match="positive"):
        voxelize(np.zeros((1, 3), np.float32), 0.0)
