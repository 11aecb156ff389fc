import numpy as np
import pytest

from nss_ros.errors import InputError
from nss_ros.simulation.fragment_picture import (
    fragment_picture,
    normal_colours,
    panorama_picture,
    range_colours,
)
from nss_ros.simulation.panorama import MISSING

RED, BLUE = (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)
FROM_ABOVE = {"azimuth": 90.0, "elevation": 90.0, "width": 100}


def test_points_are_discs_in_place():
    points = np.array([(-1.0, 0.0, 0.0), (1.0, 0.5, 0.0)])
    image = fragment_picture(points, np.array([RED, BLUE]), **FROM_ABOVE)
    red = np.argwhere((image[..., 0] > 200) & (image[..., 2] < 100))
    blue = np.argwhere((image[..., 2] > 200) & (image[..., 0] < 100))
    scale = 100 / 2.3  # 0.15 m of margin
    assert np.allclose(red.mean(axis=0), (0.65 * scale, 0.15 * scale), atol=1)
    assert np.allclose(blue.mean(axis=0), (0.15 * scale, 2.15 * scale), atol=1)
    assert (image == 255).all(axis=2).mean() > 0.9


def test_near_points_hide_far_ones_in_whatever_order():
    points = np.array([(0.0, 0.0, 0.0), (0.0, 0.0, -1.0), (1.0, 1.0, 0.0)])
    colours = np.array([RED, BLUE, RED])
    image = fragment_picture(points, colours, **FROM_ABOVE)
    assert not ((image[..., 2] > 200) & (image[..., 0] < 100)).any()
    again = fragment_picture(points[::-1], colours[::-1], **FROM_ABOVE)
    assert np.array_equal(image, again)


def test_the_ceiling_is_left_out():
    points = np.array([(0.0, 0.0, -1.5), (1.0, 1.0, -1.5), (0.0, 0.0, 1.5)])
    image = fragment_picture(points, np.array([RED, RED, BLUE]), **FROM_ABOVE)
    assert not ((image[..., 2] > 200) & (image[..., 0] < 100)).any()
    with pytest.raises(InputError, match="none up to"):
        fragment_picture(points[2:], np.array([BLUE]))


def test_edges_before_something_far_are_dark():
    grid = np.stack(np.meshgrid(np.arange(0, 2, 0.05), np.arange(0, 2, 0.05)), -1).reshape(-1, 2)
    floor = np.column_stack((grid, np.full(len(grid), -1.5)))
    table = floor[(np.abs(grid - 1) < 0.5).all(axis=1)] + (0, 0, 0.8)
    points = np.concatenate((floor, table))
    image = fragment_picture(points, np.full((len(points), 3), 0.8), **FROM_ABOVE)
    assert image[50, 50, 0] == pytest.approx(204, abs=1)
    assert image.min() < 150


def test_normals_and_ranges_have_colours_of_their_own():
    axes = np.concatenate((np.eye(3), -np.eye(3)))
    colours = normal_colours(axes)
    assert colours.min() >= 0
    assert colours.max() <= 1
    assert len(np.unique(colours.round(3), axis=0)) == 6
    near, far, farther = range_colours(np.diag([0.5, 4.5, 9.0]))
    assert near.sum() > far.sum()
    assert np.array_equal(far, farther)


def test_a_panorama_keeps_its_rows_and_shows_what_is_near_bright():
    panorama = np.full((2, 4), MISSING, dtype=np.uint16)
    panorama[1, :3] = np.array([0.5, 2.0, 4.0]) / 10 * 65535
    image = panorama_picture(panorama, 80)
    assert image.shape == (40, 80, 3)
    assert (image[:20] == 224).all()
    sums = [int(image[30, column].sum()) for column in (10, 30, 50)]
    assert sums == sorted(sums, reverse=True)
    assert (image[30, 70] == 224).all()
    with pytest.raises(InputError, match="rows and columns"):
        panorama_picture(np.zeros((0, 4), dtype=np.uint16))
