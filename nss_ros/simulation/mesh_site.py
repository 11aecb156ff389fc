"""Sites from meshes: one per stage, in one frame, of any format that trimesh reads."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from nss_ros.config.section import Positive, Section
from nss_ros.errors import FormatError, InputError
from nss_ros.simulation.clutter import with_clutter
from nss_ros.simulation.element import Element
from nss_ros.simulation.mesh import Mesh
from nss_ros.simulation.site import Rectangle, Site

MESH_ENDINGS = frozenset((".ply", ".obj", ".stl", ".off", ".glb", ".gltf", ".3mf", ".dae"))

_FLOOR_BIN = 0.05
_SAME_PLACE = 1e-3  # metres; formats round coordinates
_LEVEL = 0.9  # least z of a normal that points up
_Z_UP_FROM_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


class MeshArea(Section):
    """An area given as one mesh per stage."""

    stages: list[str] = Field(min_length=1, description="Mesh files, the first is stage 1")
    names: list[str] = Field([], description="What each stage is, for people")
    scale: Positive = Field(1.0, description="Metres per unit of the files")
    up: Literal["y", "z"] = Field(
        "z", description="Axis of the files that points up; glTF has y by convention"
    )
    floor_height: float | None = Field(
        None,
        description="Height of the bare floor, metres; none: that of the largest level surface "
        "which faces up, of the lowest where several are about as large",
    )
    clutter: float = Field(
        0.0,
        ge=0,
        le=3,
        description="Things that lie about and move between stages (stacks, scaffolds, lifts, "
        "bins), as a factor of their usual number; meshes of scans have their own; 0: none",
    )


def build_mesh_site(name: str, area: MeshArea, folder: Path, seed: int = 0) -> Site:
    """The site of an area given as meshes.

    A part of a mesh (a named geometry of a scene, or what is connected) that is the same to a
    millimetre in several stages is one element of all of them, so that points carry change labels.

    Args:
        name: of the area.
        area: its files.
        folder: that relative paths are relative to.
        seed: of the clutter; a site without it does not depend on it.

    Raises:
        InputError: a file is missing, the number of names is wrong, or no floor is found.
        FormatError: a file is not a mesh.
    """
    if area.names and len(area.names) != len(area.stages):
        raise InputError(
            f"Area {name} has {len(area.stages)} stages, but {len(area.names)} names: give one "
            "name per stage, or none."
        )
    stages: dict[bytes, set[int]] = {}
    parts: dict[bytes, tuple[str, Mesh]] = {}
    hashes = {}
    for number, file in enumerate(area.stages, start=1):
        path = folder / file
        hashes[path.name] = _sha256(path)
        for label, mesh in _parts(path, area):
            key = _shape_key(mesh)
            stages.setdefault(key, set()).add(number)
            parts.setdefault(key, (label, mesh))
    elements = tuple(
        Element("part", frozenset(stages[key]), mesh, name=label)
        for key, (label, mesh) in parts.items()
    )
    low, high = _bounds(elements)
    site = Site(
        name,
        len(area.stages),
        elements,
        Rectangle(float(low[0]), float(low[1]), float(high[0]), float(high[1])),
        _floor_height(name, elements) if area.floor_height is None else area.floor_height,
        tuple(area.names),
        {"meshes": area.model_dump(), "sha256": hashes},
    )
    return with_clutter(site, area.clutter, seed)


def _parts(path: Path, area: MeshArea) -> Iterator[tuple[str, Mesh]]:
    for label, mesh in _geometries(path):
        vertices = np.asarray(mesh.vertices, dtype=np.float64) * area.scale
        if area.up == "y":
            vertices = vertices @ _Z_UP_FROM_Y_UP.T
        triangles = np.asarray(mesh.faces, dtype=np.int32)
        if not np.isfinite(vertices[triangles]).all():
            raise FormatError(f"{path} has vertices that are not finite: export the mesh again.")
        for number, part in enumerate(_connected(vertices, triangles), start=1):
            yield f"{label} {number}", part


def _geometries(path: Path) -> list[tuple[str, Any]]:
    """Name and trimesh of each geometry of a file, placed in its scene."""
    import trimesh

    try:
        scene = trimesh.load_scene(path)
        found = [
            (str(geometry.metadata.get("name") or path.stem), geometry)
            for geometry in scene.dump()
            if isinstance(geometry, trimesh.Trimesh) and len(geometry.faces)
        ]
    except Exception as error:  # its readers raise whatever they meet
        reason = " ".join(str(error).split()) or type(error).__name__
        raise FormatError(f"{path} cannot be read as a mesh: {reason}.") from error
    if not found:
        raise FormatError(f"{path} holds no triangles: give a mesh, not a point cloud.")
    return found


def _connected(vertices: NDArray[np.float64], triangles: NDArray[np.int32]) -> Iterator[Mesh]:
    """The connected parts of a mesh, corners at the same place being one."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    places, merged = np.unique(np.round(vertices, 6), axis=0, return_inverse=True)
    corners = merged.ravel()[triangles]
    links = np.concatenate((corners[:, :2], corners[:, 1:])).T
    graph = coo_array((np.ones(links.shape[1]), links), shape=(len(places),) * 2)
    _, labels = connected_components(graph, directed=False)
    part_of = labels[corners[:, 0]]
    order = np.argsort(part_of, kind="stable")
    for rows in np.split(order, np.flatnonzero(np.diff(part_of[order])) + 1):
        used, numbers = np.unique(triangles[rows], return_inverse=True)
        yield Mesh(vertices[used], numbers.reshape(-1, 3).astype(np.int32))


def _shape_key(mesh: Mesh) -> bytes:
    """The same for the same triangles, in whatever order a file has them."""
    corners = np.round(mesh.vertices / _SAME_PLACE).astype(np.int64)[mesh.triangles]
    order = np.lexsort(np.moveaxis(corners, 2, 0)[::-1], axis=1)
    within = np.take_along_axis(corners, order[:, :, None], axis=1).reshape(-1, 9)
    return hashlib.sha256(np.unique(within, axis=0).tobytes()).digest()


def _bounds(elements: tuple[Element, ...]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    low = np.min([element.mesh.vertices.min(axis=0) for element in elements], axis=0)
    return low, np.max([element.mesh.vertices.max(axis=0) for element in elements], axis=0)


def _floor_height(name: str, elements: tuple[Element, ...]) -> float:
    """Height of the lowest of the large level surfaces that face up and are there at stage 1."""
    heights, areas = [], []
    for element in elements:
        if 1 in element.stages:
            corners = element.mesh.vertices[element.mesh.triangles]
            normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            sizes = np.linalg.norm(normals, axis=1) / 2
            up = normals[:, 2] > 2 * sizes * _LEVEL
            heights.append(corners[up, :, 2].mean(axis=1))
            areas.append(sizes[up])
    height, size = np.concatenate(heights), np.concatenate(areas)
    if not size.sum() > 0:
        raise InputError(f"Area {name} has no level surface that faces up: give 'floor_height'.")
    bins = np.floor(height / _FLOOR_BIN).astype(np.int64)
    levels, index = np.unique(bins, return_inverse=True)
    totals = np.bincount(index, size)
    lowest = int(np.flatnonzero(totals >= totals.max() / 2)[0])
    chosen = bins == levels[lowest]
    return float(np.average(height[chosen], weights=size[chosen]))


def _sha256(path: Path) -> str:
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise InputError(f"Cannot read the mesh {path}: {error.strerror}.") from error
