"""Sites from building models: a storey of one or several IFC files, staged by a plan."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import date
from fnmatch import fnmatch
from functools import cache
from glob import glob
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nss_ros.errors import InputError
from nss_ros.simulation.clutter import with_clutter
from nss_ros.simulation.element import Element, Material
from nss_ros.simulation.ifc_plan import (
    IfcArea,
    IfcFacts,
    default_plan,
    parse_date,
    read_schedule,
    ruled_material,
    states_of,
)
from nss_ros.simulation.ifc_report import plan_report
from nss_ros.simulation.ifc_state import Shape, shapes
from nss_ros.simulation.ifc_tessellation import (
    Tessellation,
    file_hash,
    import_ifcopenshell,
    is_cut_short,
    older_schema,
    open_ifc,
    tessellate,
    unread_statements,
)
from nss_ros.simulation.mesh import Mesh, merge
from nss_ros.simulation.site import Rectangle, Site

Report = Callable[[str, int, int], None]

# What has a shape but is no matter: rooms, holes, grids, texts. IfcSite is the terrain.
_IMMATERIAL = (
    *("IfcSpatialElement", "IfcSpatialStructureElement", "IfcFeatureElement", "IfcGrid"),
    *("IfcAnnotation", "IfcVirtualElement", "IfcPort", "IfcStructuralItem"),
    *("IfcStructuralActivity", "IfcPositioningElement"),
)
_NO_BODY = ("Axis", "FootPrint", "Plan", "Annotation", "Box", "Profile", "Reference", "CoG")
_METAL_CLASSES = (
    *("IfcFlowSegment", "IfcFlowFitting", "IfcReinforcingElement", "IfcMechanicalFastener"),
)
_METAL_WORDS = ("steel", "staal", "stahl", "acier", "hea", "heb", "ipe", "unp", "shs")
_GLASS_WORDS = ("glass", "glas", "glazing", "verre", "beglazing")
_TRANSPARENT = 0.4
_STOREY_HEIGHT = 3.5
_LEAST_INSIDE = 0.15  # of an element that belongs to a storey, metres
_GAP = 3.0  # in a building's outline that an added floor bridges, metres
_EDGE = 0.3
_APRON = 1.2  # ground around the lowest storey, over which one gets from door to door, metres
_LOWEST_STOREY = 0.1  # largest share of all elements below it, as foundations
_BELOW = 1.0  # the floor, metres
_GIVEN_FLOOR = 0.1
_FLOOR_SEARCH = 0.5
_LEVEL = 0.9
_GROUND_SHARE = 0.2
_GROUND_THICKNESS = 0.2
_ONE_LEVEL = 1.2  # difference of heights of storeys that are one, metres
# Elements in the middle of which the height is so far below or above that of their storey's floor
# are not where the storey says, metres; of fewer than so many nothing follows.
_LOST_BELOW, _LOST_ABOVE, _FEW = 1.5, 4.0, 3


@dataclass(frozen=True, slots=True)
class _Part:
    """An element with its geometry, model coordinates."""

    facts: IfcFacts
    mesh: Mesh
    transparent: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class _Storey:
    name: str
    elevation: float
    elements: int
    walled: bool = False


def build_ifc_site(
    name: str, area: IfcArea, folder: Path, report: Report | None = None, seed: int = 0
) -> Site:
    """The site of an area given as a storey of a building model.

    Elements of all files are taken whose geometry reaches into the height of the storey, whatever
    storey they are assigned to; coordinates are shifted to the storey's corner and floor. What
    cannot be tessellated is left out and listed in the site's source as `skipped`; what the plan
    does not do is told there as `notes`.

    Args:
        name: of the area.
        area: files, storey and plan.
        folder: that relative paths are relative to.
        report: progress of tessellation: file, percent, 100.
        seed: of the clutter; a site without it does not depend on it.

    Raises:
        InputError: a file or the storey is missing, or nothing is there at some stage.
        FormatError: a file is not valid.
    """
    paths = _files(name, area.files, folder)
    storeys, parts, skipped = _load(paths, Path(area.cache) if area.cache else None, report)
    if not parts:
        reasons = f" ({' '.join(skipped).removesuffix('.')})" if skipped else ""
        raise InputError(
            f"Area {name}: no element of the files has a shape to scan{reasons}: give files of a "
            "building."
        )
    if area.schedule:
        parts = _scheduled(parts, read_schedule(folder / area.schedule))
    everything = [part.facts for part in parts]
    if not (storeys or area.storey):
        lowest = float(min(part.mesh.vertices[:, 2].min() for part in parts))
        storeys = [_Storey("", lowest, len(parts))]
    floor, ceiling, storey = _heights(name, area, storeys)
    centres = np.array([part.mesh.vertices[:, 2].mean() for part in parts])
    is_lowest = (centres < floor - _BELOW).sum() <= _LOWEST_STOREY * len(parts)
    parts = [part for part in parts if _belongs(part.mesh, floor, ceiling, area.margin)]
    if not parts:
        raise InputError(
            f"Area {name} has no element between the heights {floor:g} and {ceiling:g} m: give "
            f"another storey ({_names(storeys)}), or floor and ceiling."
        )
    floor = _floor(parts, floor) if area.floor is None else floor
    corner = np.floor(np.min([part.mesh.vertices.min(axis=0) for part in parts], axis=0))
    origin = np.array([corner[0], corner[1], floor])
    low, high = -area.margin, ceiling - floor + area.margin
    elements = tuple(_cut(each, low, high) for each in _elements(parts, area, origin))
    elements = tuple(each for each in elements if len(each.mesh.triangles))
    _check_stages(name, elements, len(default_plan(area)[0]))
    extent = _extent(elements)
    notes = plan_report(name, area, everything, [part.facts for part in parts])
    if not area.storey and area.floor is None:
        notes += _other_storeys(name, storey, storeys)
    stages, _ = default_plan(area)
    outline = _outline(elements, _APRON if is_lowest else _EDGE)
    if area.ground and _floor_share(elements, outline, area.floor is not None) < _GROUND_SHARE:
        elements = (*elements, _ground(outline, len(stages)))
        extent = _extent(elements)
    site = Site(
        name,
        len(stages),
        elements,
        extent,
        0.0,
        tuple(stage.name for stage in stages),
        {
            "ifc": area.model_dump(mode="json"),
            "sha256": {path.name: file_hash(path) for path in paths},
            "storey": storey,
            "origin": origin.tolist(),
            "skipped": skipped,
            "notes": notes,
        },
    )
    return with_clutter(site, area.clutter, seed)


def walled_storeys(
    paths: Sequence[Path], pattern: str = "*", report: Report | None = None
) -> list[str]:
    """Names of the storeys of IFC files that hold walls or columns, from the lowest.

    Storeys without them (roofs, foundations, levels that only carry a height) are no place to
    scan. Of storeys at about one height, as in several files of one building, that of most
    elements names them all.

    Args:
        paths: IFC files of one building.
        pattern: shell pattern that the names match.
        report: progress of tessellation.

    Raises:
        InputError: a file is missing, or no storey matches.
        FormatError: a file is not valid.
    """
    storeys, _, _ = _load(paths, None, report)
    walled = [each for each in storeys if each.walled and fnmatch(each.name, pattern)]
    if not walled:
        raise InputError(
            f"No storey with walls or columns matches '{pattern}': the files have "
            f"{_names(storeys)}."
        )
    levels: list[_Storey] = []
    for storey in sorted(walled, key=lambda each: -each.elements):
        if all(abs(storey.elevation - level.elevation) > _ONE_LEVEL for level in levels):
            levels.append(storey)
    return list(dict.fromkeys(each.name for each in sorted(levels, key=lambda s: s.elevation)))


def _load(
    paths: Sequence[Path], cache_folder: Path | None, report: Report | None
) -> tuple[list[_Storey], list[_Part], list[str]]:
    """Storeys and elements of IFC files, and a sentence for each thing that is missing."""
    storeys: list[_Storey] = []
    parts: list[_Part] = []
    skipped: list[str] = []
    for path in paths:
        model = open_ifc(path)
        if older := older_schema(path):
            skipped.append(f"{path.name} is of the older schema {older}; it is read as IFC2X3.")
        if is_cut_short(path):
            skipped.append(f"{path.name} is cut short: what follows is missing.")
        elif unread := unread_statements(path, model):
            skipped.append(
                f"{path.name} has a mistake, after which {unread:,} statements are not read: "
                "export it anew."
            )
        entities = _entities(model)
        made = tessellate(path, model, entities, cache_folder, report)
        own = list(_parts(path, entities, made))
        parts += own
        storeys += [_grounded(storey, own) for storey in _storeys(model)]
        skipped += _missing(path, entities, made)
    return storeys, parts, skipped


def _grounded(storey: _Storey, parts: Sequence[_Part]) -> _Storey:
    """A storey where its elements are, if that is not at the height that the file tells.

    Models of one trade and storey often leave the height at 0.
    """
    heights = np.array(
        [
            (part.mesh.vertices[:, 2].min(), part.mesh.vertices[:, 2].max())
            for part in parts
            if part.facts.storey == storey.name
        ]
    ).reshape(-1, 2)
    middles = heights.mean(axis=1) - storey.elevation
    inside = (middles > -_LOST_BELOW) & (middles < _LOST_ABOVE)
    if len(heights) < _FEW or inside.mean() >= 0.5:
        return storey
    return replace(storey, elevation=float(np.quantile(heights[:, 0], 0.1)))


def _files(name: str, patterns: Sequence[str], folder: Path) -> list[Path]:
    paths: list[Path] = []
    for pattern in patterns:
        found = sorted(glob(str(folder / pattern)))  # noqa: PTH207 - the pattern may be absolute
        if not found:
            raise InputError(f"Area {name}: there is no IFC file {folder / pattern}.")
        paths += [Path(each) for each in found if Path(each) not in paths]
    return paths


def _storeys(model: Any) -> list[_Storey]:
    from ifcopenshell.util.placement import get_local_placement
    from ifcopenshell.util.unit import calculate_unit_scale

    scale = calculate_unit_scale(model)
    return [
        _Storey(
            str(storey.Name or ""),
            # Many files leave the placement at zero and give the attribute.
            float(get_local_placement(storey.ObjectPlacement)[2, 3] or storey.Elevation or 0.0)
            * scale,
            sum(len(relation.RelatedElements) for relation in storey.ContainsElements or ()),
            any(
                element.is_a("IfcWall") or element.is_a("IfcColumn")
                for relation in storey.ContainsElements or ()
                for element in relation.RelatedElements
            ),
        )
        for storey in model.by_type("IfcBuildingStorey")
    ]


def _entities(model: Any) -> list[Any]:
    """Everything material with a shape, in the order of the file."""
    return sorted(
        (
            product
            for product in model.by_type("IfcProduct")
            if _has_body(product) and not any(_is_a(product, name) for name in _IMMATERIAL)
        ),
        key=lambda product: int(product.id()),
    )


def _has_body(product: Any) -> bool:
    """Whether a product has a shape of its own: of assemblies, only the parts do."""
    shape = product.Representation
    return shape is not None and any(
        each.RepresentationIdentifier not in _NO_BODY for each in shape.Representations
    )


def _is_a(product: Any, name: str) -> bool:
    try:
        return bool(product.is_a(name))
    except RuntimeError:  # a class that this schema does not have
        return False


def _parts(path: Path, entities: Sequence[Any], made: Tessellation) -> Iterator[_Part]:
    meshes = made.meshes()
    see_through = np.array(
        [
            style.transparency > _TRANSPARENT or _has_word(style.name, _GLASS_WORDS)
            for style in made.style_table
        ]
        + [False],
        dtype=bool,
    )
    for entity in entities:
        if entity.id() in meshes:
            mesh, styles = meshes[entity.id()]
            yield _Part(_facts(path, entity), mesh, see_through[styles])


def _facts(path: Path, entity: Any) -> IfcFacts:
    from ifcopenshell.util.element import get_aggregate, get_container, get_materials, get_psets

    container = get_container(entity)
    sets = get_psets(entity)
    classes = _classes(entity.is_a(), entity.file.schema_identifier)
    # The blocks and layers of a wall are staged as the wall is.
    whole = get_aggregate(entity) if _is_a(entity, "IfcBuildingElementPart") else None
    if whole is not None:
        sets = get_psets(whole) | sets
        classes += _classes(whole.is_a(), entity.file.schema_identifier)
    return IfcFacts(
        file=path.name,
        classes=classes,
        name=str(entity.Name or (whole.Name if whole is not None else "") or ""),
        global_id=str(entity.GlobalId),
        storey=str(container.Name or "") if container is not None else "",
        properties={
            f"{set_name}.{key}": str(value)
            for set_name, values in sets.items()
            for key, value in values.items()
        },
        finish=_finish(entity),
        materials=tuple(str(each.Name) for each in get_materials(entity) if each.Name),
    )


@cache
def _classes(name: str, schema: str) -> tuple[str, ...]:
    """An IFC class and those above it."""
    declaration = import_ifcopenshell().schema_by_name(schema).declaration_by_name(name).as_entity()
    classes = []
    while declaration is not None:
        classes.append(str(declaration.name()))
        declaration = declaration.supertype()
    return tuple(classes)


def _finish(entity: Any) -> date | None:
    """When the last of the tasks on an element, or on what it is a part of, is finished."""
    from ifcopenshell.util.element import get_aggregate

    days: list[date | None] = []
    whole, seen = entity, set()
    while whole is not None and whole.id() not in seen:
        seen.add(whole.id())
        days += [_task_finish(task) for task in _tasks(whole)]
        whole = get_aggregate(whole)
    return max((day for day in days if day is not None), default=None)


def _tasks(entity: Any) -> Iterator[Any]:
    """Tasks that an element is given to, and tasks whose outcome it is."""
    for relation in getattr(entity, "HasAssignments", None) or ():
        if relation.is_a("IfcRelAssignsToProcess"):
            yield relation.RelatingProcess
    for relation in getattr(entity, "ReferencedBy", None) or ():
        if relation.is_a("IfcRelAssignsToProduct"):
            yield from (each for each in relation.RelatedObjects if each.is_a("IfcTask"))


def _task_finish(task: Any) -> date | None:
    """The finish of a task: in IFC4 of its time, in IFC2X3 of a control of it."""
    times = [getattr(task, "TaskTime", None)]
    times += [getattr(r, "TimeForTask", None) for r in getattr(task, "HasAssignments", None) or ()]
    finishes = [time.ActualFinish or time.ScheduleFinish for time in times if time is not None]
    return max((day for day in map(_task_day, finishes) if day is not None), default=None)


def _task_day(value: Any) -> date | None:
    """A day from ISO text, or from the calendar dates of IFC2X3."""
    calendar = getattr(value, "DateComponent", value)
    if hasattr(calendar, "YearComponent"):
        return date(calendar.YearComponent, calendar.MonthComponent, calendar.DayComponent)
    return parse_date(value)


def _missing(path: Path, entities: Sequence[Any], made: Tessellation) -> list[str]:
    there = set(made.ids.tolist())
    return [
        f"{path.name}: {entity.is_a()} {entity.GlobalId} '{entity.Name or ''}' has no valid "
        "geometry and is left out."
        for entity in entities
        if entity.id() not in there
    ]


def _heights(name: str, area: IfcArea, storeys: Sequence[_Storey]) -> tuple[float, float, str]:
    """Floor and ceiling of the area in the model, and the name of its storey."""
    if area.floor is not None:
        return area.floor, area.ceiling or area.floor + _STOREY_HEIGHT, area.storey
    matching = [storey for storey in storeys if fnmatch(storey.name, area.storey or "*")]
    if not matching:
        raise InputError(
            f"Area {name}: the model has no storey '{area.storey}', but {_names(storeys)}: name "
            "one of them, or give 'floor' and 'ceiling'."
        )
    chosen = max(matching, key=lambda storey: (storey.elements, -storey.elevation))
    above = [s.elevation for s in storeys if s.elevation > chosen.elevation + 2.0]
    next_floor = min(above, default=chosen.elevation + _STOREY_HEIGHT)
    return chosen.elevation, area.ceiling or next_floor, chosen.name


def _other_storeys(name: str, chosen: str, storeys: Sequence[_Storey]) -> list[str]:
    """A sentence on the storeys that are left out when none was asked for."""
    others = [each for each in storeys if each.name != chosen and each.elements]
    if not others:
        return []
    return [
        f"Area {name} is the storey '{chosen}', which has the most elements; left out are "
        f"{_names(others)}: --storeys '*' makes an area of each."
    ]


def _names(storeys: Sequence[_Storey]) -> str:
    names = dict.fromkeys(f"'{s.name}' at {round(s.elevation, 2) + 0.0:g} m" for s in storeys)
    return ", ".join(names) or "no storeys"


def _belongs(mesh: Mesh, floor: float, ceiling: float, margin: float) -> bool:
    """Whether an element stands or hangs in a storey, or is the slab below or above it.

    Walls and columns of the storeys below and above, which end or begin at the slabs, are not.
    """
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    inside = min(high[2], ceiling) - max(low[2], floor)
    height = high[2] - low[2]
    if inside > 0 and inside >= min(_LEAST_INSIDE, height / 2):
        return True
    near = high[2] > floor - margin and low[2] < ceiling + margin
    return bool(near and (high - low)[:2].min() > 2 * height)


def _cut(element: Element, low: float, high: float) -> Element:
    """An element without what goes on in the storeys below and above."""
    from trimesh.intersections import slice_faces_plane

    heights = element.mesh.vertices[element.mesh.triangles, 2]
    if heights.min() >= low and heights.max() <= high:
        return element
    vertices, triangles = element.mesh.vertices, element.mesh.triangles.astype(np.int64)
    for up, level in ((1, low), (-1, high)):
        if len(triangles):
            cut = slice_faces_plane(vertices, triangles, (0, 0, up), (0, 0, level))
            vertices, triangles = cut[0], cut[1]
    return replace(element, mesh=Mesh(np.asarray(vertices), triangles.astype(np.int32)))


def _floor(parts: Sequence[_Part], elevation: float) -> float:
    """Height of the largest level surface that faces up near a storey's elevation."""
    heights, sizes = _level_surfaces([part.mesh for part in parts])
    near = np.abs(heights - elevation) < _FLOOR_SEARCH
    if not near.any():
        return elevation
    levels, index = np.unique(np.round(heights[near], 2), return_inverse=True)
    return float(levels[np.argmax(np.bincount(index, sizes[near]))])


def _level_surfaces(
    meshes: Sequence[Mesh],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Height and area of every triangle that faces up."""
    corners = np.concatenate([mesh.vertices[mesh.triangles] for mesh in meshes])
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    sizes = np.linalg.norm(normals, axis=1) / 2
    up = normals[:, 2] > 2 * sizes * _LEVEL
    return corners[up, :, 2].mean(axis=1), sizes[up]


def _elements(
    parts: Sequence[_Part], area: IfcArea, origin: NDArray[np.float64]
) -> tuple[Element, ...]:
    stages, rules = default_plan(area)
    elements: list[Element] = []
    for part in parts:
        mesh = Mesh(part.mesh.vertices - origin, part.mesh.triangles)
        states = states_of(part.facts, stages, rules)
        for shape in shapes(mesh, states, 0.0, area.stud_spacing):
            elements += _elements_of(part, shape, ruled_material(part.facts, rules))
    return tuple(elements)


def _scheduled(parts: Sequence[_Part], schedule: dict[str, date]) -> list[_Part]:
    """The parts, with the dates of a schedule instead of those in the files."""
    dates = ((part, schedule.get(part.facts.global_id)) for part in parts)
    return [
        part if finish is None else replace(part, facts=replace(part.facts, finish=finish))
        for part, finish in dates
    ]


def _elements_of(part: _Part, shape: Shape, material: Material | None) -> Iterator[Element]:
    """A shape as an element; of the element itself, glass apart from the rest.

    A material given by a rule is that of the element as a whole, not of its frame or its props.
    """
    kind, name = part.facts.classes[0], part.facts.name
    if shape.label:
        yield Element(kind, shape.stages, shape.mesh, shape.material, f"{name}, {shape.label}")
        return
    if material is not None:
        yield Element(kind, shape.stages, shape.mesh, material, name)
        return
    for glass in (False, True):
        chosen = part.transparent == glass
        if chosen.any():
            mesh = Mesh(shape.mesh.vertices, np.ascontiguousarray(shape.mesh.triangles[chosen]))
            told = Material.GLASS if glass else _material(part.facts)
            yield Element(kind, shape.stages, mesh, told, name)


def _material(facts: IfcFacts) -> Material:
    if any(name in facts.classes for name in ("IfcPlate", "IfcWindow")) and _has_word(
        facts.name, _GLASS_WORDS
    ):
        return Material.GLASS
    metal = any(name in facts.classes for name in _METAL_CLASSES)
    metal = metal or _has_word(" ".join((facts.name, *facts.materials)), _METAL_WORDS)
    return Material.METAL if metal else Material.MATT


def _has_word(text: str, words: tuple[str, ...]) -> bool:
    """Whether a text has a word that begins with one of some words."""
    return any(
        token.startswith(words)
        for token in "".join(c if c.isalpha() else " " for c in text.lower()).split()
    )


def _check_stages(name: str, elements: Sequence[Element], stages: int) -> None:
    for stage in range(1, stages + 1):
        if not any(stage in element.stages for element in elements):
            raise InputError(
                f"Area {name} has no element at stage {stage}: no rule of the plan gives any."
            )


def _extent(elements: Sequence[Element]) -> Rectangle:
    low = np.min([element.mesh.vertices.min(axis=0) for element in elements], axis=0)
    high = np.max([element.mesh.vertices.max(axis=0) for element in elements], axis=0)
    return Rectangle(float(low[0]), float(low[1]), float(high[0]), float(high[1]))


def _outline(elements: Sequence[Element], edge: float) -> Any:
    """Outline of a storey seen from above, its gaps closed and its holes filled, as polygons.

    Args:
        elements: of the storey.
        edge: how far the outline lies outside of them, metres.
    """
    import shapely

    hulls = [shapely.MultiPoint(element.mesh.vertices[:, :2]).convex_hull for element in elements]
    with np.errstate(divide="ignore", invalid="ignore"):  # GEOS meets them and copes
        covered = shapely.union_all([hull.buffer(0.01, quad_segs=1) for hull in hulls])
        closed = covered.buffer(_GAP / 2, join_style="mitre").buffer(-_GAP / 2, join_style="mitre")
    filled = [shapely.Polygon(piece.exterior) for piece in shapely.get_parts(closed)]
    return shapely.union_all(filled).buffer(edge, join_style="mitre").simplify(0.02)


def _floor_share(elements: Sequence[Element], outline: Any, is_given: bool) -> float:
    """Area of level surfaces near height 0 at stage 1, against that of the outline.

    Where the height is given, only surfaces at that height are the floor: a filigree slab, say,
    is not before it is poured.
    """
    heights, sizes = _level_surfaces([e.mesh for e in elements if 1 in e.stages])
    near = np.abs(heights) < (_GIVEN_FLOOR if is_given else _EDGE)
    return float(sizes[near].sum() / max(outline.area, 1e-9))


def _ground(outline: Any, stages: int) -> Element:
    """A slab under a storey, and not around it, where nobody would put a tripod."""
    import shapely
    from trimesh.creation import extrude_polygon

    pieces = [
        extrude_polygon(piece, _GROUND_THICKNESS, engine="earcut")
        for piece in shapely.get_parts(outline)
    ]
    lowered = np.array([0.0, 0.0, -_GROUND_THICKNESS])
    slabs = [
        Mesh(np.asarray(piece.vertices) + lowered, np.asarray(piece.faces, dtype=np.int32))
        for piece in pieces
    ]
    return Element("ground", frozenset(range(1, stages + 1)), merge(slabs), name="added floor")
