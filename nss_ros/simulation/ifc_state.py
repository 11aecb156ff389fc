"""What an element looks like before it is finished, from the box around it.

A partition as its track, as studs, or boarded on one side, each without its doors and windows;
a slab on props; material in a stack.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from nss_ros.geometry import Transform, from_yaw, inverse, transform_points
from nss_ros.simulation.element import Material
from nss_ros.simulation.ifc_openings import Panel, panels
from nss_ros.simulation.ifc_plan import State
from nss_ros.simulation.mesh import Mesh, box, cylinder, merge, moved

_STUD = 0.05
_TRACK = 0.04
_BOARD = 0.025
_PROP_SPACING = 1.4
_PROP_RADIUS = 0.035
_STACK = (1.2, 0.8, 0.5)
_LEAST_PROP = 0.5


@dataclass(frozen=True, slots=True)
class Shape:
    """Something that is there of an element while it is being built.

    Attributes:
        label: what it is of the element; empty for the finished element itself.
        stages: when it is there.
        mesh: metres, z up.
        material: of what is added; MATT for the element itself, whose own material counts.
    """

    label: str
    stages: frozenset[int]
    mesh: Mesh
    material: Material


def shapes(
    mesh: Mesh, states: Mapping[State, frozenset[int]], floor: float, spacing: float
) -> list[Shape]:
    """All that is there of an element over its states; what stays from one to the next is one.

    Args:
        mesh: the finished element, metres, z up.
        states: stages at which the element is in each state.
        floor: height of the floor on which props and stacks stand, metres.
        spacing: of studs, metres.
    """

    def during(*wanted: State) -> frozenset[int]:
        return frozenset().union(*(states.get(state, frozenset()) for state in wanted))

    framed = during(State.STUDS, State.ONE_SIDE)
    tracked = framed | during(State.TRACK)
    found = [Shape("", during(State.BUILT, State.PROPPED), mesh, Material.MATT)]
    if propped := during(State.PROPPED):
        props = _props(mesh, floor)
        found += [Shape("props", propped, merge(props), Material.METAL)] if props else []
    if stacked := during(State.STACKED):
        found.append(Shape("stack", stacked, _stack(mesh, floor), Material.MATT))
    if tracked:
        T_map_wall, size = _upright_box(mesh)
        wall = panels(moved(mesh, inverse(T_map_wall)), size)
        frame = [
            Shape("track", tracked, _floor_track(wall, size), Material.METAL),
            Shape("studs", framed, _stud_frame(wall, size, spacing), Material.METAL),
            Shape("board", during(State.ONE_SIDE), _board(wall, size), Material.MATT),
        ]
        found += [replace(each, mesh=moved(each.mesh, T_map_wall)) for each in frame]
    return [shape for shape in found if shape.stages and len(shape.mesh.triangles)]


def _floor_track(wall: Sequence[Panel], size: NDArray[np.float64]) -> Mesh:
    """Where the wall stands on the floor: not in doors."""
    standing = [panel for panel in wall if panel.bottom < _TRACK]
    return merge([box((p.start, 0, 0), (p.end, size[1], _TRACK)) for p in standing])


def _stud_frame(wall: Sequence[Panel], size: NDArray[np.float64], spacing: float) -> Mesh:
    """Studs on a grid and beside openings, and the track under the ceiling."""
    length, thickness, height = size.tolist()
    last = max(length - _STUD, 0.0)
    grid = np.append(np.arange(0.0, last, spacing), last).tolist()
    pieces = []
    for low, high, bottom, top in _runs(wall):
        # A stud on the grid that is all but the one at the end of the run is left out.
        inner = [x for x in grid if low + _STUD <= x <= high - 2 * _STUD]
        ends = [low, max(high - _STUD, low)] if high - low > 3 * _STUD else [low]
        starts = dict.fromkeys([*ends, *inner])
        pieces += [box((x, 0, bottom), (min(x + _STUD, high), thickness, top)) for x in starts]
    hung = [panel for panel in wall if panel.top > height - _TRACK]
    tracks = [box((p.start, 0, height - _TRACK), (p.end, thickness, height)) for p in hung]
    return merge([*pieces, *tracks])


def _board(wall: Sequence[Panel], size: NDArray[np.float64]) -> Mesh:
    return merge(
        [box((p.start, size[1] - _BOARD, p.bottom), (p.end, size[1], p.top)) for p in wall]
    )


def _runs(wall: Sequence[Panel]) -> list[tuple[float, float, float, float]]:
    """Neighbouring panels of one bottom and top as one: start, end, bottom, top."""
    runs: list[tuple[float, float, float, float]] = []
    for panel in sorted(wall, key=lambda p: (p.bottom, p.top, p.start)):
        if runs and runs[-1][1:] == (panel.start, panel.bottom, panel.top):
            runs[-1] = (runs[-1][0], panel.end, panel.bottom, panel.top)
        else:
            runs.append((panel.start, panel.end, panel.bottom, panel.top))
    return runs


def _upright_box(mesh: Mesh) -> tuple[Transform, NDArray[np.float64]]:
    """`T_map_box` of the box around a wall, x along it from a lower corner, and its size."""
    planar = mesh.vertices[:, :2] - mesh.vertices[:, :2].mean(axis=0)
    _, _, axes = np.linalg.svd(planar, full_matrices=False)
    yaw = float(np.arctan2(axes[0, 1], axes[0, 0]))
    turned = transform_points(inverse(from_yaw(yaw, (0.0, 0.0, 0.0))), mesh.vertices)
    low = turned.min(axis=0)
    T_map_turned = from_yaw(yaw, (0.0, 0.0, 0.0))
    corner = transform_points(T_map_turned, low[None])[0]
    return from_yaw(yaw, corner), turned.max(axis=0) - low


def _props(mesh: Mesh, floor: float) -> list[Mesh]:
    """Props on a grid under a slab that is high enough above the floor."""
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    if low[2] - floor < _LEAST_PROP:
        return []
    rows = [
        np.arange(a + _PROP_SPACING / 2, b, _PROP_SPACING)
        for a, b in zip(low[:2], high[:2], strict=True)
    ]
    return [
        cylinder((x, y, floor), (x, y, low[2]), _PROP_RADIUS, sides=8)
        for x in rows[0]
        for y in rows[1]
        if _below(mesh, x, y)
    ]


def _below(mesh: Mesh, x: float, y: float) -> bool:
    """Whether a vertical line through (x, y) meets the mesh."""
    a, b, c = (mesh.vertices[mesh.triangles[:, corner], :2] for corner in range(3))
    p = np.array([x, y])
    sides = np.stack([_cross(a, b, p), _cross(b, c, p), _cross(c, a, p)])
    return bool(((sides >= 0).all(axis=0) | (sides <= 0).all(axis=0)).any())


def _cross(
    start: NDArray[np.float64], end: NDArray[np.float64], point: NDArray[np.float64]
) -> NDArray[np.float64]:
    along, aside = end - start, point - start
    return np.asarray(along[:, 0] * aside[:, 1] - along[:, 1] * aside[:, 0])


def _stack(mesh: Mesh, floor: float) -> Mesh:
    """The material of an element as a stack beside the place where it will be."""
    centre = (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2
    half = np.array(_STACK) / 2
    low = (centre[0] - half[0], centre[1] - half[1], floor)
    return box(low, (centre[0] + half[0], centre[1] + half[1], floor + _STACK[2]))
