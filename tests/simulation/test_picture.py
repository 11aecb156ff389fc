import numpy as np
import pytest
from PIL import Image as Pillow

from nss_ros.config import SiteConfig
from nss_ros.errors import InputError
from nss_ros.simulation.element import Element, Material, stages_from
from nss_ros.simulation.mesh import box
from nss_ros.simulation.picture import (
    NEW_COLOUR,
    interior_picture,
    interiors_picture,
    kind_colour,
    stage_picture,
    stages_picture,
    write_png,
)
from nss_ros.simulation.procedural.floor import build_floor
from nss_ros.simulation.rendering import SECTION_COLOUR
from nss_ros.simulation.site import Rectangle, Site

# A floor of 8 x 4 m with a column at (2, 2), a desk at (6, 2) from stage 2 on, and a ceiling.
HALL = Site(
    "1",
    2,
    (
        Element("floor_slab", stages_from(1, 2), box((0, 0, -0.2), (8, 4, 0))),
        Element("ceiling_slab", stages_from(1, 2), box((0, 0, 3), (8, 4, 3.2))),
        Element("column", stages_from(1, 2), box((1.5, 1.5, 0), (2.5, 2.5, 3))),
        Element("desk", stages_from(2, 2), box((5.5, 1.5, 0), (6.5, 2.5, 0.7))),
    ),
    Rectangle(0, 0, 8, 4),
    stage_names=("empty", "furnished"),
)


def plan(stage, **settings):
    """From straight above, x to the right, y up."""
    return stage_picture(HALL, stage, width=176, azimuth=90, elevation=90, **settings)


def pixel(image, x, y):
    scale = image.shape[1] / 8.8  # 0.4 m of margin
    return image[round((4.4 - y) * scale), round((x + 0.4) * scale)].astype(int)


def hue(colour):
    colour = np.asarray(colour, float)
    return colour / colour.sum()


def test_a_plan_shows_the_floor_below_the_ceiling_in_place():
    image = plan(1)
    assert image.shape == (96, 176, 3)
    assert image.dtype == np.uint8
    assert (image[0, 0] == 255).all()  # nothing there
    floor = pixel(image, 4, 2)
    assert floor.min() > 120
    assert np.ptp(floor) < 8
    assert np.abs(pixel(image, 6, 2) - floor).max() < 12


def test_solids_have_the_colour_of_sections_where_they_are_cut():
    expected = 255 * np.array(SECTION_COLOUR) ** (1 / 1.35)
    assert np.abs(pixel(plan(1), 2, 2) - expected).max() <= 1
    # Above the column there is nothing to cut.
    assert pixel(plan(1, cut_height=3.1), 2, 2).min() > expected.max() + 20


def test_new_things_are_tinted_and_old_ones_are_not():
    image = plan(2, mark_new=True)
    new, old = pixel(image, 6, 2), pixel(image, 4, 3)
    assert np.abs(hue(new**1.35) - hue(NEW_COLOUR)).max() < 0.02
    assert np.ptp(old) < 12
    assert hue(pixel(plan(2), 6, 2))[0] < hue(new)[0] - 0.05


def test_corners_are_darker_than_open_floor():
    image = plan(2)
    assert pixel(image, 6, 2.6).mean() < pixel(image, 4, 2.6).mean() - 8


def test_an_oblique_view_keeps_one_frame_for_all_stages():
    first, second = (stage_picture(HALL, stage, width=100) for stage in (1, 2))
    assert first.shape == second.shape
    changed = (first != second).any(axis=2)
    assert 0.005 < changed.mean() < 0.3


def test_the_same_site_gives_the_same_pixels():
    assert np.array_equal(stages_picture(HALL, 200), stages_picture(HALL, 200))


def test_the_stages_stand_side_by_side_below_their_titles():
    image = stages_picture(HALL, 400)
    left, gap, right = image[:, :192], image[:, 192:208], image[:, 208:]
    assert (gap == 255).all()
    for half in (left, right):
        assert (half[:22] < 128).any()  # the title
        assert (half[40:] < 200).any()


def test_an_interior_looks_along_the_heading():
    size = (60, 40)
    towards_desk = interior_picture(HALL, 2, (4, 2, 0.5), 0, size)
    without = interior_picture(HALL, 1, (4, 2, 0.5), 0, size)
    assert hue(towards_desk[20, 30])[0] > hue(without[20, 30])[0] + 0.03
    # Half a turn later the column is ahead and the desk is behind.
    assert np.array_equal(
        interior_picture(HALL, 2, (4, 2, 0.5), 180, size),
        interior_picture(HALL, 1, (4, 2, 0.5), 180, size),
    )
    # The desk's left edge in the view is its far-y edge in the map.
    left = interior_picture(HALL, 2, (4, 1.5, 0.5), 0, size)
    assert hue(left[20, 25])[0] > hue(left[20, 35])[0] + 0.02


def test_interiors_of_all_stages_stand_side_by_side():
    image = interiors_picture(HALL, (4, 2, 1.6), 0, 300)
    assert image.shape[1] == 300
    left, right = image[22:, :142], image[22:, 158:]
    assert (left != right).any()


def test_the_procedural_floor_fills_its_picture():
    site = build_floor("1", SiteConfig(), 0)
    image = stage_picture(site, 1, width=120)
    seen = (image < 250).any(axis=2)
    assert 0.4 < seen.mean() < 0.95
    assert image[seen].std() > 20


@pytest.mark.parametrize(
    ("kind", "like"),
    [("stairs", "core_wall"), ("IfcWallStandardCase", "core_wall"), ("air_duct", "duct")],
)
def test_kinds_of_one_trade_have_one_colour(kind, like):
    assert kind_colour(element(kind)) == kind_colour(element(like))


def test_unknown_kinds_have_the_colour_of_their_material():
    colours = {kind_colour(element("thingummy", material)) for material in Material}
    assert len(colours) == len(Material)


def element(kind, material=Material.MATT):
    return Element(kind, stages_from(1, 1), box((0, 0, 0), (1, 1, 1)), material)


def test_png_holds_the_picture(tmp_path):
    image = plan(2)
    write_png(tmp_path / "all.png", image)
    assert np.array_equal(np.asarray(Pillow.open(tmp_path / "all.png")), image)
    write_png(tmp_path / "few.png", image, colours=16)
    few = np.asarray(Pillow.open(tmp_path / "few.png").convert("RGB"))
    assert len(np.unique(few.reshape(-1, 3), axis=0)) <= 16
    assert np.abs(few.astype(int) - image).mean() < 5
    assert (tmp_path / "few.png").stat().st_size < (tmp_path / "all.png").stat().st_size


def test_pictures_that_cannot_be_are_refused():
    with pytest.raises(InputError, match="Stage 3 does not exist"):
        stage_picture(HALL, 3)
    with pytest.raises(InputError, match="elevation"):
        stage_picture(HALL, 1, elevation=0)
    with pytest.raises(InputError, match="field of view"):
        interior_picture(HALL, 1, (0, 0, 1), 0, field_of_view=180)
