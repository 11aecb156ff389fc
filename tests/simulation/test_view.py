import numpy as np
import pytest

from nss_ros.errors import InputError
from nss_ros.simulation.element import Element, stages_from
from nss_ros.simulation.mesh import box
from nss_ros.simulation.site import Rectangle, Site
from nss_ros.simulation.view import EYE_HEIGHT, widest_view

FLOOR = Element("floor_slab", stages_from(1, 2), box((0, 0, -0.2), (20, 6, 0)))


def site(*elements, floor=FLOOR, height=0.0):
    return Site("A", 2, (floor, *elements), Rectangle(0, 0, 20, 6), height)


def wall(x, stages):
    return Element("wall", frozenset(stages), box((x, 0, 0), (x + 0.2, 6, 3)))


SIDES = [Element("wall", stages_from(1, 2), box((0, y, 0), (20, y + 0.2, 3))) for y in (-0.2, 6)]


def test_the_view_goes_where_there_is_most_room_at_the_worst_stage():
    # At stage 2 the hall is divided; its right part is the larger one.
    ends = (wall(-0.2, (1, 2)), wall(20, (1, 2)))
    view = widest_view(site(*ends, *SIDES, wall(3, (2,))))
    x, _, z = view.eye
    assert z == EYE_HEIGHT
    assert x > 3.2
    assert view.heading in np.arange(16) * 22.5


def test_one_does_not_look_out_of_the_site():
    view = widest_view(site(wall(-0.2, (1, 2)), *SIDES))  # open at the right
    assert np.cos(np.radians(view.heading)) < 0.5


def test_changes_are_looked_at():
    view = widest_view(site(wall(-0.2, (1, 2)), wall(20, (1, 2)), wall(12, (2,)), *SIDES))
    ahead = np.cos(np.radians(view.heading)) * (12 - view.eye[0])
    assert ahead > 0


def test_the_eye_is_above_the_floor_of_the_site():
    raised = Element("floor_slab", stages_from(1, 2), box((0, 0, 3.8), (10, 6, 4)))
    view = widest_view(site(floor=raised, height=4.0))
    assert view.eye[2] == pytest.approx(4 + EYE_HEIGHT)
    assert view.eye[0] < 10  # not where there is no floor


def test_a_site_without_a_place_to_stand_is_refused():
    pit = Element("floor_slab", stages_from(1, 1), box((0, 0, -0.2), (20, 6, 0)))
    with pytest.raises(InputError, match="Area A has no place"):
        widest_view(site(floor=pit))
