import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from nss_ros.geometry import from_yaw
from nss_ros.simulation.mesh import (
    Opening,
    box,
    boxes,
    cylinder,
    cylinders,
    merge,
    mound,
    moved,
    slab,
    wall,
)


def volume(mesh):
    a, b, c = (mesh.vertices[mesh.triangles[:, k]] for k in range(3))
    return float(np.einsum("ni,ni->n", a, np.cross(b, c)).sum() / 6)


def edges_used_once_each_way(mesh):
    edges = np.concatenate([mesh.triangles[:, [k, (k + 1) % 3]] for k in range(3)])
    forth, back = set(map(tuple, edges)), set(map(tuple, edges[:, ::-1]))
    return len(forth) == len(edges) and forth == back


def test_a_box_is_closed_with_normals_outwards():
    mesh = box((-1, 0, 2), (1, 3, 2.5))
    assert edges_used_once_each_way(mesh)
    assert volume(mesh) == pytest.approx(3.0)


@pytest.mark.parametrize("end", [(0, 0, 2), (2, 0, 0), (1, 1, np.sqrt(2))])
def test_a_cylinder_is_closed_with_normals_outwards(end):
    mesh = cylinder((0, 0, 0), end, 0.5, sides=200)
    assert edges_used_once_each_way(mesh)
    assert volume(mesh) == pytest.approx(np.pi * 0.25 * 2, rel=1e-3)


def test_a_mound_rises_from_the_floor():
    mesh = mound(1.0, 0.5, np.random.default_rng(0))
    a, b, c = (mesh.vertices[mesh.triangles[:, k]] for k in range(3))
    assert (np.cross(b - a, c - a)[:, 2] > 0).mean() > 0.9
    assert mesh.vertices[:, 2].min() == 0
    assert mesh.vertices[:, 2].max() < 0.8


def test_openings_take_their_volume_from_a_wall():
    door, window = Opening(0.5, 1.5, 0.0, 2.1), Opening(2.0, 3.0, 0.9, 2.3)
    mesh = wall(4.0, (0.0, 0.0), (0.2, 3.0), [window, door])
    assert volume(mesh) == pytest.approx(0.2 * (4 * 3 - 1 * 2.1 - 1 * 1.4))


def test_merged_meshes_keep_their_triangles():
    first, second = (
        box((0, 0, 0), (1, 1, 1)),
        moved(box((0, 0, 0), (1, 2, 1)), from_yaw(1.0, (5, 0, 0))),
    )
    assert volume(merge([first, second])) == pytest.approx(3.0)
    assert len(merge([]).triangles) == 0


@given(hnp.arrays(float, (5, 2, 3), elements=st.floats(-10, 10, allow_subnormal=False)))
def test_many_boxes_are_the_same_as_one_by_one(corners):
    lower, upper = corners.min(axis=1), corners.max(axis=1)
    solid = (lower < upper).all(axis=1)
    together = boxes(lower, upper)
    apart = merge([box(a, b) for a, b in zip(lower[solid], upper[solid], strict=True)])
    assert np.array_equal(together.vertices, apart.vertices)
    assert np.array_equal(together.triangles, apart.triangles)


def test_many_cylinders_are_the_same_as_one_by_one():
    starts, ends, radii = [(0, 0, 0), (1, 2, 0)], [(0, 0, 2), (4, 2, 1)], [0.1, 0.3]
    together = cylinders(starts, ends, radii, sides=8)
    each = [cylinder(a, b, r, 8) for a, b, r in zip(starts, ends, radii, strict=True)]
    apart = merge(each)
    assert np.allclose(together.vertices, apart.vertices)
    assert np.array_equal(together.triangles, apart.triangles)


def test_holes_take_their_volume_from_a_slab_as_far_as_they_lie_in_it():
    mesh = slab((0, 0, -0.3), (10, 6, 0), [(1, 1, 3, 4), (9, 5, 12, 8)])
    assert volume(mesh) == pytest.approx(0.3 * (60 - 6 - 1))


def test_boards_that_end_above_a_door_leave_nothing_in_it():
    mesh = wall(2.0, (0.0, 0.01), (0.1, 3.0), [Opening(0.5, 1.5, 0.0, 2.1)])
    inside = (mesh.vertices[:, 0] > 0.5) & (mesh.vertices[:, 0] < 1.5)
    assert (mesh.vertices[inside, 2] >= 2.1).all()
    assert volume(mesh) == pytest.approx(0.1 * (2 * 2.99 - 1 * 2.09))
