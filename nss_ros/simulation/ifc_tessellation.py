"""Triangles of the elements of an IFC file, tessellated once and then read from a cache."""

from __future__ import annotations

import hashlib
import io
import json
import os
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from nss_ros.errors import FormatError, InputError, NssError
from nss_ros.files import write_file
from nss_ros.simulation.mesh import Mesh

Report = Callable[[str, int, int], None]
"""Progress: what is being worked on, how much of it is done, of how much."""

_THREADS = 2
_LAYOUT = 1  # of the cache files
# IFC 2x of 2000 and 2x2 of 2003; the header of a file is at its beginning.
_OLDER_SCHEMA = re.compile(rb"FILE_SCHEMA\s*\(\s*\(\s*'(IFC2X2?(?:_\w+)?)'", re.IGNORECASE)
_HEADER = 20_000
_STATEMENT = re.compile(rb"^\s*#\d+\s*=", re.MULTILINE)


@dataclass(frozen=True, slots=True)
class Style:
    """A surface style of an IFC file.

    Attributes:
        name: as the file has it.
        transparency: 0 opaque to 1 invisible.
    """

    name: str
    transparency: float


@dataclass(frozen=True, slots=True)
class Tessellation:
    """Triangles of all elements of one file, in the order of their entity numbers.

    Attributes:
        ids: (k,) int64 entity numbers (`#12` is 12) of the elements with geometry.
        vertices: (n, 3) float64, metres, world coordinates of the file.
        triangles: (m, 3) int32, indices of vertices.
        styles: (m,) int32, per triangle the index of its style, -1 for none.
        vertex_ends: (k,) int64, where the vertices of each element end.
        triangle_ends: (k,) int64, where the triangles of each element end.
        style_table: what the indices in `styles` mean.
    """

    ids: NDArray[np.int64]
    vertices: NDArray[np.float64]
    triangles: NDArray[np.int32]
    styles: NDArray[np.int32]
    vertex_ends: NDArray[np.int64]
    triangle_ends: NDArray[np.int64]
    style_table: tuple[Style, ...]

    def meshes(self) -> dict[int, tuple[Mesh, NDArray[np.int32]]]:
        """Mesh and styles of its triangles by entity number."""
        found = {}
        first_vertex = first_triangle = 0
        for index, entity in enumerate(self.ids.tolist()):
            last_vertex, last_triangle = self.vertex_ends[index], self.triangle_ends[index]
            triangles = self.triangles[first_triangle:last_triangle] - np.int32(first_vertex)
            mesh = Mesh(self.vertices[first_vertex:last_vertex], triangles)
            found[entity] = (mesh, self.styles[first_triangle:last_triangle])
            first_vertex, first_triangle = last_vertex, last_triangle
        return found


def import_ifcopenshell() -> Any:
    """The package ifcopenshell, with its geometry kernel.

    Raises:
        InputError: it is not installed, or what triangulates the ground of a site is not.
    """
    try:
        import ifcopenshell
        import ifcopenshell.geom
        import mapbox_earcut  # noqa: F401 - trimesh uses it; better missed now than half-way
    except ImportError as error:
        raise InputError(
            f"Reading IFC files needs the packages ifcopenshell and mapbox_earcut ({error}): "
            "pip install ifcopenshell mapbox_earcut."
        ) from error
    return ifcopenshell


def open_ifc(path: Path) -> Any:
    """An IFC file as ifcopenshell's model; one of an older schema as if it were IFC2X3.

    Raises:
        InputError: the file is not there, or ifcopenshell is not installed.
        FormatError: it is not an IFC file.
    """
    ifcopenshell = import_ifcopenshell()
    if not path.is_file():
        raise InputError(f"There is no IFC file {path}.")
    try:
        if older := older_schema(path):
            text = path.read_text(encoding="latin-1").replace(older, "IFC2X3", 1)
            model = ifcopenshell.file.from_string(text)
        else:
            model = ifcopenshell.open(str(path))
        model.by_type("IfcProduct")
    except Exception as error:  # the parser's errors have no common class
        reason = " ".join(str(error).split())
        raise FormatError(
            f"{path} cannot be read as an IFC file: {reason.rstrip('.')}. Export it anew as "
            "IFC2X3, IFC4 or IFC4X3."
        ) from error
    return model


def older_schema(path: Path) -> str | None:
    """The schema of a file that is a little older than IFC2X3, whose elements are the same."""
    with path.open("rb") as file:
        found = _OLDER_SCHEMA.search(file.read(_HEADER))
    return found[1].decode() if found else None


def is_cut_short(path: Path) -> bool:
    """Whether the end of a STEP file is missing, as after an interrupted download."""
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - 256))
        return b"END-ISO-10303-21" not in file.read()


def unread_statements(path: Path, model: Any) -> int:
    """How many statements of a file its model lacks: ifcopenshell stops at a mistake in silence."""
    written = len(_STATEMENT.findall(path.read_bytes()))
    return max(0, written - sum(1 for _ in model))


def cache_folder() -> Path:
    """Where tessellations are kept unless the user says otherwise."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "nss_ros" / "ifc"


def tessellate(
    path: Path,
    model: Any,
    entities: Sequence[Any],
    cache: Path | None = None,
    report: Report | None = None,
) -> Tessellation:
    """Triangles of the elements of a file.

    What was tessellated is kept by the hash of the file, the version of ifcopenshell and the
    elements asked for, so that the next call only reads it.

    Args:
        path: of the file.
        model: the file, opened.
        entities: elements that have a representation; those that ifcopenshell cannot
            tessellate are missing in the result.
        cache: folder; by default that of `cache_folder`.
        report: called with the file's name and percent done.
    """
    ids = np.sort(np.array([entity.id() for entity in entities], dtype=np.int64))
    kept = (cache or cache_folder()) / f"{_key(path, ids)}.npz"
    found = _read(kept)
    if found is None:
        found = _compute(path.name, model, entities, report)
        _write(kept, found)
    if report:
        report(path.name, 100, 100)
    return found


def file_hash(path: Path) -> str:
    """SHA-256 of a file, hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _key(path: Path, ids: NDArray[np.int64]) -> str:
    parts = (file_hash(path), import_ifcopenshell().version, str(_LAYOUT))
    return hashlib.sha256("\n".join(parts).encode() + ids.tobytes()).hexdigest()[:32]


def _compute(name: str, model: Any, entities: Sequence[Any], report: Report | None) -> Tessellation:
    shapes = dict(_shapes(name, model, entities, report))
    names: dict[Style, int] = {}
    vertices, triangles, styles = [], [], []
    vertex_count = 0
    for entity in sorted(shapes):
        points, faces, indices, table = shapes[entity]
        numbers = [names.setdefault(style, len(names)) for style in table]
        lookup = np.array([*numbers, -1], dtype=np.int32)
        vertices.append(points)
        triangles.append(faces + vertex_count)
        styles.append(lookup[np.where((indices >= 0) & (indices < len(table)), indices, -1)])
        vertex_count += len(points)
    return Tessellation(
        np.array(sorted(shapes), dtype=np.int64),
        np.concatenate([np.zeros((0, 3)), *vertices]),
        np.concatenate([np.zeros((0, 3), np.int32), *triangles]).astype(np.int32),
        np.concatenate([np.zeros(0, np.int32), *styles]),
        np.cumsum([len(part) for part in vertices], dtype=np.int64),
        np.cumsum([len(part) for part in triangles], dtype=np.int64),
        tuple(names),
    )


_Shape = tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64], list[Style]]


def _shapes(
    name: str, model: Any, entities: Sequence[Any], report: Report | None
) -> list[tuple[int, _Shape]]:
    """Shapes as the kernel's threads deliver them, in no particular order."""
    if not entities:
        return []
    geom = import_ifcopenshell().geom
    settings = geom.settings()
    settings.set("use-world-coords", True)
    iterator = geom.iterator(settings, model, _THREADS, include=list(entities))
    found: list[tuple[int, _Shape]] = []
    going = iterator.initialize()
    while going:
        shape = iterator.get()
        arrays = _arrays(shape.geometry)
        if arrays:
            found.append((shape.id, arrays))
        if report:
            report(name, min(int(iterator.progress()), 99), 100)
        going = iterator.next()
    return found


def _arrays(geometry: Any) -> _Shape | None:
    """What the kernel made of one element, without triangles of no area; None if none is left."""
    points = np.array(geometry.verts, dtype=np.float64).reshape(-1, 3)
    faces = np.array(geometry.faces, dtype=np.int64).reshape(-1, 3)
    indices = np.array(geometry.material_ids, dtype=np.int64)
    if len(indices) != len(faces):
        indices = np.full(len(faces), -1, dtype=np.int64)
    a, b, c = (points[faces[:, corner]] for corner in range(3))
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    good = areas > 1e-9  # False for what is not finite, too
    if not good.any():
        return None
    used, numbers = np.unique(faces[good], return_inverse=True)
    styles = [Style(str(style.name), _finite(style.transparency)) for style in geometry.materials]
    return points[used], numbers.reshape(-1, 3), indices[good], styles


def _finite(value: float) -> float:
    return float(value) if np.isfinite(value) else 0.0


def _write(path: Path, found: Tessellation) -> None:
    """Keep a tessellation; a cache that cannot be written only costs time."""
    arrays = {name: getattr(found, name) for name in _ARRAYS}
    table = json.dumps([(style.name, style.transparency) for style in found.style_table])
    buffer = io.BytesIO()
    np.savez_compressed(buffer, style_table=np.array(table), **arrays)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_file(path, buffer.getvalue())
    except (OSError, NssError):
        return


def _read(path: Path) -> Tessellation | None:
    """What was kept, or None if that is missing or damaged."""
    try:
        with np.load(path) as data:
            table = tuple(Style(*row) for row in json.loads(str(data["style_table"])))
            return Tessellation(**{name: data[name] for name in _ARRAYS}, style_table=table)
    except (OSError, KeyError, ValueError, BadZipFile, EOFError):
        return None


_ARRAYS = ("ids", "vertices", "triangles", "styles", "vertex_ends", "triangle_ends")
