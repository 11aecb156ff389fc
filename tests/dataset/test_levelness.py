"""Levelled scans of the bundled bag, and the same turned over."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from nss_ros.bag import read_log
from nss_ros.dataset.levelness import files_look_levelled, looks_levelled, other_vertical_axis
from nss_ros.dataset.ply import write_ply
from nss_ros.fragment import FragmentId

BAG = Path(__file__).parents[2] / "bags" / "three_stages"


@pytest.fixture(scope="module")
def scans():
    return [each.points for each in read_log(BAG).fragments.values()]


def write(file, points):
    write_ply(file, dict(zip("xyz", points.T, strict=True)))


def turned(points, rotation):
    return (points @ rotation.as_matrix().T).astype(np.float32)


def test_scans_of_a_tripod_look_levelled_whatever_their_heading(scans):
    for number, points in enumerate(scans[::4]):
        assert looks_levelled(points)
        assert looks_levelled(turned(points, Rotation.from_euler("z", 40 * number, degrees=True)))


@pytest.mark.parametrize("origin", [(0.0, 0.0, 1.6), (25.0, -40.0, 3.0)])
def test_so_do_they_where_the_origin_is_not_the_sensor(scans, origin):
    for points in scans[::6]:
        assert looks_levelled(points + np.array(origin, np.float32))


@settings(max_examples=8)
@given(st.integers(0, 10_000))
def test_in_random_frames_hardly_any_do(scans, seed):
    some = scans[::3]
    # A scanner that lies so that a wall is its floor does look it: one of a thousand frames.
    rotations = Rotation.random(len(some), random_state=seed)
    looks = [looks_levelled(turned(*each)) for each in zip(some, rotations, strict=True)]
    assert np.mean(looks) < 0.2


def test_a_tilt_of_many_degrees_is_not_level(scans):
    tilted = [turned(each, Rotation.from_euler("x", 8, degrees=True)) for each in scans[::6]]
    assert not any(map(looks_levelled, tilted))


@pytest.mark.parametrize(
    "points",
    [
        np.zeros((0, 3), np.float32),
        np.ones((1, 3), np.float32),
        np.full((500, 3), np.nan, np.float32),
        np.random.default_rng(0).normal(0, 2, (5000, 3)).astype(np.float32),
    ],
    ids=["none", "one point", "not finite", "noise"],
)
def test_what_says_nothing_does_not_look_levelled(points):
    assert not looks_levelled(points)


def test_a_few_that_do_not_look_it_do_not_matter(tmp_path, scans):
    files = []
    for number, points in enumerate(scans[:6]):
        file = tmp_path / f"{number}.ply"
        write(file, points[:50] if number == 3 else points)
        files.append((FragmentId("1", 1, number), file))
    assert files_look_levelled(files)
    for _, file in files[:2]:
        write(file, scans[0][:50])
    assert not files_look_levelled(files)
    assert not files_look_levelled([])


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("axis", ["x", "y"])
def test_another_axis_that_is_vertical_is_named(tmp_path, scans, axis, sign):
    up = np.roll((0.0, 0.0, 1.0), "zxy".index(axis)) * sign
    rotation = Rotation.align_vectors([up], [(0.0, 0.0, 1.0)])[0]
    files = [(FragmentId("1", 1, number), tmp_path / f"{number}.ply") for number in range(4)]
    for (_, file), points in zip(files, scans[::6], strict=False):
        write(file, turned(points, rotation))
    assert not files_look_levelled(files)
    assert other_vertical_axis(files) == axis


def test_no_axis_is_named_where_none_is_vertical(tmp_path, scans):
    file = tmp_path / "0.ply"
    write(file, turned(scans[0], Rotation.from_euler("xy", (40, 30), degrees=True)))
    assert other_vertical_axis([(FragmentId("1", 1, 0), file)]) is None
    assert other_vertical_axis([]) is None
