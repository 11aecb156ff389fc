import numpy as np
import pytest
from shapely.geometry import box as rectangle
from shapely.ops import unary_union

from nss_ros.config import SiteConfig
from nss_ros.simulation.procedural.furniture import furnish
from nss_ros.simulation.procedural.layout import Construction, RoomKind, draw_layout
from nss_ros.simulation.procedural.plan import draw_plan

CONFIGS = {
    "small": SiteConfig(width=14, depth=11),
    "office": SiteConfig(width=60, depth=17),
    "deep": SiteConfig(width=50, depth=26, height=4.0),
    "deeper": SiteConfig(width=60, depth=38),
    "flats": SiteConfig(width=40, depth=14, use="residential", wings=[{"length": 20, "turn": 60}]),
    "hospital": SiteConfig(width=14, depth=16, use="hospital", wings=[{"length": 50, "arc": -60}]),
    "laboratory": SiteConfig(width=40, depth=15, use="laboratory"),
}


def drawn(name, seed=0, **changes):
    config = CONFIGS[name].model_copy(update=changes)
    plan = draw_plan(config, np.random.default_rng((seed, 1)))
    return plan, draw_layout(plan, config, np.random.default_rng((seed, 2)))


@pytest.mark.parametrize("name", CONFIGS)
@pytest.mark.parametrize("seed", range(3))
def test_rooms_cores_and_corners_fill_the_floor_without_overlap(name, seed):
    plan, layout = drawn(name, seed)
    rooms = [r.area for r in layout.rooms if not r.name.startswith("lobby")]
    areas = [rectangle(r.x0, r.y0, r.x1, r.y1) for r in (*rooms, *(c.area for c in plan.cores))]
    covered = unary_union(areas)
    assert covered.area == pytest.approx(sum(a.area for a in areas), rel=1e-6)
    corners = sum(np.diff(plan.grid.stations)[bay] for bay in plan.grid.corners)
    assert covered.area == pytest.approx((plan.grid.length - corners) * plan.grid.depth, rel=1e-6)


@pytest.mark.parametrize("name", CONFIGS)
def test_every_room_can_be_entered(name):
    """From the first corridor one gets everywhere: through doors or where there is no wall."""
    plan, layout = drawn(name)
    reached = {r.name for r in layout.rooms if r.name.startswith(("corridor 1", "lobby"))}
    edges = [(wall, door) for wall in layout.walls for door in wall.doors]
    passages = []
    for wall, door in edges:
        middle = wall.pose @ [(door.start + door.end) / 2, 0, 0, 1]
        across = wall.pose[:2, 1] * 0.1
        ends = [_room_at(layout, *(middle[:2] + side * across)) for side in (-1, 1)]
        passages.append(tuple(room.name for room in ends))
    for room in layout.rooms:
        passages += _without_wall(layout, room)
    for _ in range(len(layout.rooms)):
        for one, other in passages:
            if one in reached or other in reached:
                reached |= {one, other}
    assert {r.name for r in layout.rooms} == reached
    assert plan.cores


def _room_at(layout, x, y):
    return next(
        r for r in layout.rooms if r.area.x0 <= x <= r.area.x1 and r.area.y0 <= y <= r.area.y1
    )


def _without_wall(layout, room):
    """Rooms beside the four edges of a room, where no wall stands between."""
    passages = []
    area = room.area
    x, y = (area.x0 + area.x1) / 2, (area.y0 + area.y1) / 2
    for edge, beyond in (
        ((x, area.y0), (x, area.y0 - 0.1)),
        ((x, area.y1), (x, area.y1 + 0.1)),
        ((area.x0, y), (area.x0 - 0.1, y)),
        ((area.x1, y), (area.x1 + 0.1, y)),
    ):
        if not any(_covers(wall, *edge) for wall in layout.walls):
            beside = [r for r in layout.rooms if r is not room and _holds(r, *beyond)]
            passages += [(room.name, other.name) for other in beside]
    return passages


def _covers(wall, x, y):
    (x0, y0), (x1, y1) = wall.start, wall.end
    return x0 - 1e-6 <= x <= x1 + 1e-6 and y0 - 1e-6 <= y <= y1 + 1e-6


def _holds(room, x, y):
    return room.area.x0 < x < room.area.x1 and room.area.y0 < y < room.area.y1


def test_full_repetition_gives_copies():
    for repetition, distinct in ((1.0, 1), (0.0, 4)):
        _, layout = drawn("office", repetition=repetition)
        cells = [r for r in layout.rooms if r.kind is RoomKind.CELL]
        widths = {round(r.area.x1 - r.area.x0, 6) for r in cells}
        assert len(cells) > 4
        assert (len(widths) == 1) == (distinct == 1)
        assert len(widths) >= distinct


def test_flats_have_blockwork_between_them_and_offices_have_none():
    flats, office = drawn("flats")[1], drawn("office")[1]
    assert any(wall.construction is Construction.BLOCK for wall in flats.walls)
    assert not any(wall.construction is Construction.BLOCK for wall in office.walls)


@pytest.mark.parametrize("name", CONFIGS)
def test_doors_lie_in_their_walls(name):
    for wall in drawn(name)[1].walls:
        assert wall.length > 0.5
        for door in wall.doors:
            assert 0.2 < door.start < door.end < wall.length - 0.2


def test_columns_stand_on_a_repeating_grid():
    plan, _ = drawn("deeper")
    bays = np.diff(plan.grid.stations)
    assert np.allclose(bays, bays[0])
    assert 6 <= bays[0] <= 8
    assert np.diff(plan.rows).max() <= 8.5


@pytest.mark.parametrize("name", CONFIGS)
def test_furniture_stays_in_its_room(name):
    kinds = set()
    for room in drawn(name)[1].rooms:
        for piece in furnish(room, 1.0, np.random.default_rng(0)):
            kinds.add(piece.kind)
            assert room.area.x0 < piece.x < room.area.x1
            assert room.area.y0 < piece.y < room.area.y1
    assert kinds


def test_mirrored_rooms_are_furnished_the_other_way_round():
    _, layout = drawn("office", repetition=1.0)
    cells = [r for r in layout.rooms if r.kind is RoomKind.CELL]
    left = next(r for r in cells if not r.mirrored)
    right = next(r for r in cells if r.mirrored and r.corridor_y == left.corridor_y)
    one, other = (furnish(room, 0.0, np.random.default_rng(0)) for room in (left, right))
    assert len(one) == len(other) > 0
    for a, b in zip(one, other, strict=True):
        assert a.x - left.area.x0 == pytest.approx(right.area.x1 - b.x)
        assert a.y == pytest.approx(b.y)
