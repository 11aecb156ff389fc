"""The envelope: nets at the open edge, then walls with windows or curtain walls, then glass."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from nss_ros.geometry import from_yaw
from nss_ros.simulation.element import Element, Material
from nss_ros.simulation.mesh import Mesh, Opening, boxes, cylinders, merge, moved, wall
from nss_ros.simulation.procedural.plan import FACADE_THICKNESS, MIDDLE, NORTH, SOUTH, Plan
from nss_ros.simulation.procedural.programme import FACADE, FRAMES, GLAZING, Programme

_FRAME = 0.07
_GLASS = 0.012
_PIER = 0.75
_NET_TOP = 1.15
_SCAFFOLD_GAP = 0.35
_ALWAYS = -math.inf


@dataclass(frozen=True, slots=True)
class _Style:
    """Of all facades of a floor: windows of one width and sill, or a curtain wall."""

    curtain: bool
    module: float
    sill: float
    head: float


@dataclass(frozen=True, slots=True)
class _Panel:
    """One stretch of facade: x along it, y outwards from its inner face, true metres."""

    name: str
    length: float
    zone: int
    T_plan_panel: np.ndarray
    mirror: bool
    stretch: float


def build_facade(
    plan: Plan, programme: Programme, standing: bool, rng: np.random.Generator
) -> list[Element]:
    """Facades of all bays and of both ends.

    Args:
        plan: of the structure; meshes are in its coordinates.
        programme: of the works.
        standing: it is there from the beginning, as in a renovation.
        rng: of style and progress.
    """
    styles = [_draw_style(plan, rng), _draw_style(plan, rng)]
    elements = []
    for panel in _panels(plan):
        style = styles[int(panel.name.endswith("end"))]
        delay = float(rng.normal(0.0, 0.3))
        parts = _curtain(panel, style, plan) if style.curtain else _windows(panel, style, plan)
        for kind, work, material, mesh in parts:
            start = _ALWAYS if standing else work + delay
            stages = programme.during(panel.zone, start)
            name = f"{kind.replace('_', ' ')} {panel.name}"
            elements.append(Element(kind, stages, _placed(mesh, panel), material, name))
        if not standing:
            elements += _temporary(panel, plan, programme, delay)
    return [element for element in elements if element.stages]


def _draw_style(plan: Plan, rng: np.random.Generator) -> _Style:
    curtain = bool(rng.random() < 0.35)
    width = float(rng.choice([1.2, 1.35, 1.5]) if curtain else rng.choice([1.0, 1.2, 1.5, 1.8]))
    sill = float(rng.choice([0.8, 0.9, 0.9, 0.15]))
    return _Style(curtain, width, sill, min(2.4, plan.height - 0.5))


def _panels(plan: Plan) -> list[_Panel]:
    grid = plan.grid
    panels = []
    for bay in range(grid.bays):
        x0, x1 = float(grid.stations[bay]), float(grid.stations[bay + 1])
        for y, side, name in ((0.0, SOUTH, "south"), (grid.depth, NORTH, "north")):
            length = grid.length_at(bay, y)
            if length > 0.1:
                pose = from_yaw(0.0, (x0, y, 0.0))
                zone, stretch = plan.zone((x0 + x1) / 2, side), (x1 - x0) / length
                label = f"{name} bay {bay + 1}"
                panels.append(_Panel(label, length, zone, pose, side == SOUTH, stretch))
    out = FACADE_THICKNESS
    for x, turn, name in ((0.0, np.pi / 2, "west"), (grid.length, -np.pi / 2, "east")):
        start = -out if turn > 0 else grid.depth + out
        pose = from_yaw(turn, (x, start, 0.0))
        zone = plan.zone(x, MIDDLE)
        panels.append(_Panel(f"{name} end", grid.depth + 2 * out, zone, pose, False, 1.0))
    return panels


def _placed(mesh: Mesh, panel: _Panel) -> Mesh:
    """From the panel's frame to plan coordinates."""
    scale = np.array([panel.stretch, -1.0 if panel.mirror else 1.0, 1.0])
    triangles = mesh.triangles[:, ::-1] if panel.mirror else mesh.triangles
    return moved(Mesh(mesh.vertices * scale, triangles), panel.T_plan_panel)


def _windows(panel: _Panel, style: _Style, plan: Plan) -> list[tuple[str, float, Material, Mesh]]:
    count = max(1, int((panel.length - 0.4) / (style.module + _PIER)))
    pitch = panel.length / count
    starts = (np.arange(count) + 0.5) * pitch - style.module / 2
    openings = [Opening(x, x + style.module, style.sill, style.head) for x in starts.tolist()]
    near, far = 0.12, 0.12 + _FRAME
    frames = [_frame(opening, near, far) for opening in openings]
    middle = (near + far) / 2
    panes = boxes(
        [(o.start + _FRAME, middle, o.bottom + _FRAME) for o in openings],
        [(o.end - _FRAME, middle + _GLASS, o.top - _FRAME) for o in openings],
    )
    masonry = wall(panel.length, (0.0, 0.0), (FACADE_THICKNESS, plan.height), openings)
    return [
        ("facade", FACADE, Material.MATT, masonry),
        ("window_frame", FRAMES, Material.MATT, merge(frames)),
        ("window_glass", GLAZING, Material.GLASS, panes),
    ]


def _frame(opening: Opening, near: float, far: float) -> Mesh:
    """A frame with mullions between its lights."""
    count = max(1, round((opening.end - opening.start) / 0.9))
    edges = np.linspace(opening.start, opening.end - _FRAME, count + 1)
    rails = np.array([opening.bottom, opening.top - _FRAME])
    lower = [(x, near, opening.bottom) for x in edges] + [(opening.start, near, z) for z in rails]
    upper = [(x + _FRAME, far, opening.top) for x in edges]
    upper += [(opening.end, far, z + _FRAME) for z in rails]
    return boxes(lower, upper)


def _curtain(panel: _Panel, style: _Style, plan: Plan) -> list[tuple[str, float, Material, Mesh]]:
    """Mullions at a regular pitch, transoms, closed panels below the sill, glass above."""
    count = max(2, round(panel.length / style.module))
    edges = np.linspace(0.0, panel.length - 0.06, count + 1)
    levels = np.array([0.02, style.sill, style.head, plan.height - 0.08])
    near, far = 0.08, 0.22
    frame = boxes(
        [(x, near, 0.0) for x in edges] + [(0.0, near + 0.02, z) for z in levels],
        [(x + 0.06, far, plan.height) for x in edges]
        + [(panel.length, far - 0.02, z + 0.06) for z in levels],
    )
    fields = list(zip(edges[:-1] + 0.06, edges[1:], strict=True))
    pane, closed = 0.15, style.sill > 0.3
    glass_levels = [(levels[1], levels[2]), (levels[2], levels[3])]
    if not closed:
        glass_levels.append((levels[0], levels[1]))
    glass = boxes(
        [(a, pane, low + 0.06) for a, _ in fields for low, _ in glass_levels],
        [(b, pane + _GLASS, high) for _, b in fields for _, high in glass_levels],
    )
    parts = [
        ("mullions", FRAMES, Material.METAL, frame),
        ("curtain_glass", GLAZING, Material.GLASS, glass),
    ]
    if closed:
        lower = [(a, pane - 0.04, levels[0]) for a, _ in fields]
        upper = [(b, pane + 0.04, levels[1]) for _, b in fields]
        parts.append(("spandrel", GLAZING - 0.4, Material.METAL, boxes(lower, upper)))
    return parts


def _temporary(panel: _Panel, plan: Plan, programme: Programme, delay: float) -> list[Element]:
    """Posts, rails and a net until the facade comes; a scaffold outside until the windows."""
    edge = FACADE_THICKNESS
    posts = np.arange(0.15, panel.length, 2.0)
    rails = [(0.0, edge, z) for z in (0.5, 1.0)]
    guard = cylinders(
        [*((x, edge, 0.0) for x in posts), *rails],
        [*((x, edge, 1.1) for x in posts), *((panel.length, edge, z) for _, _, z in rails)],
        0.022,
        sides=6,
    )
    net = boxes((0.0, edge + 0.03, 0.02), (panel.length, edge + 0.035, _NET_TOP))
    out = edge + _SCAFFOLD_GAP
    tubes = [(x, y) for x in np.arange(0.6, panel.length, 2.4) for y in (out, out + 0.7)]
    ledgers = [(y, z) for y in (out, out + 0.7) for z in (0.15, 1.1, 2.1)]
    scaffold = merge(
        [
            cylinders(
                [*((x, y, -1.0) for x, y in tubes), *((0.0, y, z) for y, z in ledgers)],
                [
                    *((x, y, plan.height) for x, y in tubes),
                    *((panel.length, y, z) for y, z in ledgers),
                ],
                0.024,
                sides=6,
            ),
            # Boards well off the level of the floor: nobody puts a tripod there.
            boxes(
                [(0.0, out, z) for z in (-0.9, 1.1)],
                [(panel.length, out + 0.7, z + 0.05) for z in (-0.9, 1.1)],
            ),
        ]
    )
    parts = [
        ("edge_protection", FACADE + delay, Material.METAL, guard),
        ("net", FACADE + delay, Material.MATT, net),
        ("facade_scaffold", FRAMES + 0.8 + delay, Material.METAL, scaffold),
    ]
    return [
        Element(
            kind,
            programme.during(panel.zone, _ALWAYS, end),
            _placed(mesh, panel),
            material,
            f"{kind.replace('_', ' ')} {panel.name}",
        )
        for kind, end, material, mesh in parts
    ]
