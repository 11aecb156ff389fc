"""Things of a building site on the free floor of a site that has none: stacks, scaffolds, bins.

What stands on a procedural floor is put there by its plan (`procedural.clutter`); a building
model has no plan, only meshes. Here free floor is found in the mesh of each stage, and things of
the same catalogue are put on it, as many as the stage of the works brings, most of them anew at
each stage. They stand in nothing, keep off doors, and never cut off a way that was there.
"""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from nss_ros.geometry import Transform, from_yaw, transform_points
from nss_ros.simulation.element import Element, stages_from
from nss_ros.simulation.mesh import Mesh, moved
from nss_ros.simulation.occupancy import door_triangles, surface_samples
from nss_ros.simulation.procedural.things import DENSITIES, STAYS, Thing, draw_thing
from nss_ros.simulation.scene import Scene
from nss_ros.simulation.site import Site

_CELL = 0.1
_LOW, _TALL = 1.3, 2.6  # what is not higher than this needs so much free height, metres
_FOOT = 0.03  # above which something is in the way of a thing, metres
_STEP, _HEAD = 0.3, 2.0  # between which something is in the way of a person, metres
_LEVEL = 0.05  # of the floor, metres
_EYE = 1.0  # from which one looks down for the floor, metres
_DOOR_CLEARANCE = 0.9
_PASSAGE = 0.3  # half the width of a way, metres
_WINDOW = 3.0  # around a thing in which ways must stay, metres
_LEAST_PART = 0.5  # of floor that may be cut off, square metres
_MARGIN = 0.08  # around a thing, metres
_TRIES = 30
_SHELL, _FINISHING = 2, 5  # of `things.PHASES`


def with_clutter(site: Site, amount: float, seed: int) -> Site:
    """A site with what lies about on it; its source tells the seed and the number of things.

    Args:
        site: without it.
        amount: as of `clutter`; with 0 the site stays as it is and does not depend on the seed.
        seed: as of `clutter`.
    """
    if amount == 0:
        return site
    things = clutter(site, amount, seed)
    return replace(
        site,
        elements=(*site.elements, *things),
        source={**site.source, "clutter_seed": seed, "clutter": len(things)},
    )


def clutter(site: Site, amount: float, seed: int) -> list[Element]:
    """What lies about on a site, stage by stage.

    Args:
        site: without it.
        amount: factor of the number of things; 1 as on procedural floors.
        seed: of everything; the area's name counts too.

    Returns:
        Elements in the map frame.
    """
    grounds = [_Ground.of(site, stage) for stage in range(1, site.stages + 1)]
    phases = np.rint(np.linspace(_SHELL, _FINISHING, site.stages)).astype(int).tolist()
    elements: list[Element] = []
    for stage, (ground, phase) in enumerate(zip(grounds, phases, strict=True), start=1):
        rng = np.random.default_rng((seed, zlib.crc32(site.area.encode()), stage))
        for _ in range(int(rng.poisson(ground.walked_area() * DENSITIES[phase] * amount))):
            thing = draw_thing(phase, rng)
            stays = stage < site.stages and rng.random() < STAYS
            shape = thing.make(rng)
            for _ in range(_TRIES):
                pose = ground.propose(shape, thing.against_wall, rng)
                if pose is None:
                    break
                both = stays and grounds[stage].takes(shape, pose)
                if ground.takes(shape, pose):
                    for taking in grounds[stage - 1 : stage + both]:
                        taking.put(shape, pose)
                    stages = stages_from(stage, stage + both)
                    elements.append(_element(thing, shape, pose, stages, len(elements) + 1))
                    break
    return elements


def _element(
    thing: Thing, shape: Mesh, pose: Transform, stages: frozenset[int], number: int
) -> Element:
    name = f"{thing.kind.replace('_', ' ')} {number}"
    return Element(thing.kind, stages, moved(shape, pose), thing.material, name)


@dataclass(slots=True)
class _Ground:
    """The floor of one stage in cells (nx, ny) of 0.1 m, and what is free of it.

    Attributes:
        origin: (3,) lower corner of cell (0, 0), z of the floor, metres.
        free: for low and for tall things, where they may stand.
        walls: distance of every cell from what stands there, metres.
        ways: where one can walk, if it is not too narrow.
    """

    origin: NDArray[np.float64]
    free: dict[float, NDArray[np.bool_]]
    walls: NDArray[np.float64]
    ways: NDArray[np.bool_]

    @classmethod
    def of(cls, site: Site, stage: int) -> _Ground:
        extent = site.extent
        origin = np.array([extent.x0, extent.y0, site.floor_height])
        shape = (
            math.ceil((extent.x1 - extent.x0) / _CELL),
            math.ceil((extent.y1 - extent.y0) / _CELL),
        )
        mesh = site.stage_mesh(stage)
        corners = mesh.mesh.vertices[mesh.mesh.triangles] - origin
        doors = door_triangles(site, mesh)
        floor = _floor(Scene(mesh.mesh), origin, shape)
        low, tall = (_taken(corners, shape, _FOOT, top) for top in (_LOW, _TALL))
        swing = _taken(corners[doors], shape, _FOOT, _TALL)
        if swing.any():
            swing = ndimage.distance_transform_edt(~swing, sampling=_CELL) < _DOOR_CLEARANCE
        in_the_way = _taken(corners[~doors], shape, _STEP, _HEAD)
        return cls(
            origin,
            {_LOW: floor & ~low & ~swing, _TALL: floor & ~tall & ~swing},
            _distance(floor & ~low),
            floor & ~in_the_way,
        )

    def walked_area(self) -> float:
        """Floor that one can walk on, square metres."""
        return float(np.count_nonzero(_distance(self.ways) >= _PASSAGE)) * _CELL**2

    def propose(
        self, shape: Mesh, against_wall: bool, rng: np.random.Generator
    ) -> Transform | None:
        """A pose for a thing, which may not fit; None if there is none."""
        reach = float(-shape.vertices[:, 1].min()) + _MARGIN
        near = self.walls >= reach
        if against_wall:
            near &= self.walls < reach + 2 * _CELL
        places = np.flatnonzero(self.free[_height(shape)] & near)
        if len(places) == 0:
            return None
        i, j = np.unravel_index(int(rng.choice(places)), near.shape)
        place = self.origin + np.array([(i + 0.5) * _CELL, (j + 0.5) * _CELL, 0.0])
        if not against_wall:
            return from_yaw(float(rng.choice([0.0, np.pi / 2])) + rng.normal(0.0, 0.25), place)
        # Its back, at -y, to the wall.
        window = self.walls[max(i - 1, 0) : i + 2, max(j - 1, 0) : j + 2]
        along_x, along_y = (
            window[-1].mean() - window[0].mean(),
            (window[:, -1] - window[:, 0]).mean(),
        )
        return from_yaw(math.atan2(-along_x, along_y) + rng.normal(0.0, np.radians(2.5)), place)

    def takes(self, shape: Mesh, pose: Transform) -> bool:
        """Whether a thing fits there and leaves all ways open."""
        cells = self._cells(shape, pose, _MARGIN)
        limits = np.array(self.ways.shape)
        if (cells < 0).any() or (cells >= limits).any():
            return False
        if not self.free[_height(shape)][tuple(cells.T)].all():
            return False
        margin = round(_WINDOW / _CELL)
        low = np.maximum(cells.min(axis=0) - margin, 0)
        high = np.minimum(cells.max(axis=0) + margin + 1, limits)
        before = self.ways[low[0] : high[0], low[1] : high[1]]
        after = before.copy()
        after[tuple((cells - low).T)] = False
        return _still_linked(before, after)

    def put(self, shape: Mesh, pose: Transform) -> None:
        """Take up the room of a thing; what stands there already does not matter."""
        cells = self._cells(shape, pose, 0.0)
        cells = cells[((cells >= 0) & (cells < self.ways.shape)).all(axis=1)]
        for free in self.free.values():
            free[tuple(cells.T)] = False
        self.ways[tuple(cells.T)] = False

    def _cells(self, shape: Mesh, pose: Transform, margin: float) -> NDArray[np.int64]:
        """Cells (n, 2) under the box around a thing."""
        low = shape.vertices[:, :2].min(axis=0) - margin
        high = shape.vertices[:, :2].max(axis=0) + margin
        steps = np.ceil((high - low) / (_CELL / 2)).astype(int) + 1
        x, y = (np.linspace(a, b, n) for a, b, n in zip(low, high, steps, strict=True))
        grid = np.stack(np.meshgrid(x, y, [0.0], indexing="ij"), axis=-1).reshape(-1, 3)
        places = transform_points(pose, grid) - self.origin
        return np.unique(np.floor(places[:, :2] / _CELL).astype(np.int64), axis=0)


def _height(shape: Mesh) -> float:
    return _LOW if shape.vertices[:, 2].max() <= _LOW else _TALL


def _still_linked(before: NDArray[np.bool_], after: NDArray[np.bool_]) -> bool:
    """Whether no part of the floor that one could walk to is cut off."""
    old, _ = ndimage.label(_distance(before) >= _PASSAGE)
    new, count = ndimage.label(_distance(after) >= _PASSAGE)
    parts = np.bincount(new.ravel(), minlength=count + 1)
    large = np.flatnonzero(parts * _CELL**2 >= _LEAST_PART)
    homes = [old[new == part].max() for part in large if part]
    return len(set(homes)) == len(homes)


def _distance(free: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Distance of free cells from those that are not, and from the edge of the map, metres."""
    padded = np.pad(free, 1)
    return np.asarray(ndimage.distance_transform_edt(padded, sampling=_CELL)[1:-1, 1:-1])


def _taken(
    corners: NDArray[np.float64], shape: tuple[int, int], bottom: float, top: float
) -> NDArray[np.bool_]:
    """Cells in which triangles (m, 3, 3) are between two heights."""
    low, high = corners.min(axis=1), corners.max(axis=1)
    size = np.array(shape) * _CELL
    inside = (high >= (0.0, 0.0, bottom)) & (low <= (*size, top))
    taken = np.zeros(shape, dtype=bool)
    for points in surface_samples(corners[inside.all(axis=1)], _CELL / 2):
        between = points[(points[:, 2] > bottom) & (points[:, 2] < top)]
        cells = np.floor(between[:, :2] / _CELL).astype(np.int64)
        cells = cells[((cells >= 0) & (cells < shape)).all(axis=1)]
        taken[cells[:, 0], cells[:, 1]] = True
    return taken


def _floor(scene: Scene, origin: NDArray[np.float64], shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Cells in whose middle there is floor at its height."""
    cells = np.indices(shape).reshape(2, -1).T
    origins = np.column_stack((cells + 0.5, np.zeros(len(cells)))) * _CELL + origin
    origins[:, 2] += _EYE
    down = np.tile((0.0, 0.0, -1.0), (len(cells), 1))
    drop = scene.cast(origins, down).distances.reshape(shape)
    return np.asarray(np.abs(drop - _EYE) < _LEVEL)
