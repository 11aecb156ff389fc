"""Point clouds in PLY files.

A strict reader of our own: Open3D warns and returns an empty cloud for a damaged file, so a
broken download would look like a fragment without points.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from nss_ros.errors import FormatError
from nss_ros.files import write_file

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_NAMES = {
    "f4": "float", "f8": "double", "i4": "int", "u4": "uint", "i2": "short", "u2": "ushort",
    "i1": "char", "u1": "uchar",
}  # fmt: skip
_HEADER_LINES = 10_000


@dataclass(slots=True)
class _Element:
    name: str
    count: int
    fields: list[tuple[str, str]] = field(default_factory=list)
    has_list: bool = False


def read_ply(path: Path) -> NDArray[np.float64]:
    """The vertex coordinates of a PLY file, (n, 3) float64, non-finite ones included.

    As many vertices are read as the header says; what follows them is ignored, as other readers
    do. ASCII numbers keep all their digits.

    Raises:
        FormatError: the file cannot be read, is not PLY, has no x, y, z, or is truncated.
    """
    columns = read_columns(path)
    return np.column_stack([columns[axis].astype(np.float64) for axis in "xyz"])


def read_columns(path: Path) -> dict[str, NDArray[Any]]:
    """All properties of a PLY file's vertices, (n,) each; of an ASCII file all as float64.

    Raises:
        FormatError: as `read_ply`.
    """
    try:
        with path.open("rb") as stream:
            byte_order, elements = _read_header(stream, path)
            body = stream.read()
    except OSError as error:
        raise FormatError(f"Cannot read point cloud {path}: {error.strerror}.") from error
    skipped, vertex = _vertex_element(elements, path)
    if byte_order:
        return _binary_vertices(body, byte_order, skipped, vertex, path)
    return _ascii_vertices(body, skipped, vertex, path)


def count_vertices(path: Path) -> int:
    """How many vertices a PLY file's header says it has.

    Raises:
        FormatError: the file cannot be read or is not PLY.
    """
    try:
        with path.open("rb") as stream:
            _, elements = _read_header(stream, path)
    except OSError as error:
        raise FormatError(f"Cannot read point cloud {path}: {error.strerror}.") from error
    return _vertex_element(elements, path)[1].count


def write_ply(path: Path, columns: Mapping[str, NDArray[Any]]) -> None:
    """Write vertices as binary little-endian PLY, one property per column of equal length.

    Raises:
        FormatError: the file cannot be written.
    """
    dtype = [(name, f"<{column.dtype.str[1:]}") for name, column in columns.items()]
    table = np.empty(len(next(iter(columns.values()))), dtype=dtype)
    for name, column in columns.items():
        table[name] = column
    properties = "".join(f"property {_NAMES[code[1:]]} {name}\n" for name, code in dtype)
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(table)}\n{properties}end_header\n"
    )
    write_file(path, header.encode() + table.tobytes())


def _read_header(stream: BinaryIO, path: Path) -> tuple[str, list[_Element]]:
    if stream.readline(16).rstrip() != b"ply":
        raise FormatError(f"{path} is not a PLY file: its first line must be 'ply'.")
    byte_order = None
    elements: list[_Element] = []
    for _ in range(_HEADER_LINES):
        line = stream.readline(4096)
        words = line.decode("ascii", errors="replace").split()
        match words:
            case ["end_header"]:
                if byte_order is None:
                    raise FormatError(f"The header of {path} has no 'format' line.")
                return byte_order, elements
            case ["format", name, _] if name in _FORMATS:
                byte_order = _FORMATS[name]
            case ["element", name, count] if count.isdecimal():
                elements.append(_Element(name, int(count)))
            case ["property", "list", _, _, _] if elements:
                elements[-1].has_list = True
            case ["property", kind, name] if elements and kind in _TYPES:
                elements[-1].fields.append((name, _TYPES[kind]))
            case ["comment" | "obj_info", *_]:
                pass
            case _ if line.endswith(b"\n"):
                text = ascii(line.decode("ascii", errors="replace").strip()[:60])
                raise FormatError(f"The header of {path} has a line that is not PLY: {text}.")
            case _:
                break
    raise FormatError(f"The header of {path} does not end: the file is truncated; copy it again.")


def _vertex_element(elements: list[_Element], path: Path) -> tuple[list[_Element], _Element]:
    names = [element.name for element in elements]
    if "vertex" not in names:
        raise FormatError(f"{path} has no 'vertex' element: it holds no point cloud.")
    vertex = elements[names.index("vertex")]
    fields = [name for name, _ in vertex.fields]
    missing = [axis for axis in "xyz" if axis not in fields]
    if missing:
        raise FormatError(f"The vertices of {path} have no property '{missing[0]}'.")
    if vertex.has_list or len(set(fields)) < len(fields):
        raise FormatError(
            f"The vertices of {path} have a list or a repeated property: keep x, y and z only."
        )
    return elements[: names.index("vertex")], vertex


def _binary_vertices(
    body: bytes, byte_order: str, skipped: list[_Element], vertex: _Element, path: Path
) -> dict[str, NDArray[Any]]:
    if any(element.has_list for element in skipped):
        raise FormatError(f"{path} has a list before its vertices: write the vertices first.")
    start = sum(
        element.count * np.dtype(kind).itemsize for element in skipped for _, kind in element.fields
    )
    dtype = np.dtype([(name, byte_order + kind) for name, kind in vertex.fields])
    available = max(len(body) - start, 0) // dtype.itemsize
    _check_count(vertex, available, path)
    table = np.frombuffer(body, dtype, count=vertex.count, offset=start if vertex.count else 0)
    # Copies in the machine's byte order.
    return {name: table[name].astype(kind) for name, kind in vertex.fields}


def _ascii_vertices(
    body: bytes, skipped: list[_Element], vertex: _Element, path: Path
) -> dict[str, NDArray[Any]]:
    rows = [line for line in body.splitlines() if line.strip()]
    start = sum(element.count for element in skipped)
    rows = rows[start : start + vertex.count]
    _check_count(vertex, len(rows), path)
    width = len(vertex.fields)
    words = b" ".join(rows).split()
    if len(words) != vertex.count * width:
        raise FormatError(
            f"A vertex in {path} does not have {width} numbers, as the header says: "
            "the file is damaged; write it again."
        )
    try:
        numbers = np.array(words, dtype=np.bytes_).astype(np.float64)
    except ValueError as error:
        raise FormatError(f"{path} holds a coordinate that is not a number: {error}.") from error
    table = numbers.reshape(vertex.count, width)
    return {name: table[:, i].copy() for i, (name, _) in enumerate(vertex.fields)}


def _check_count(vertex: _Element, available: int, path: Path) -> None:
    if available < vertex.count:
        raise FormatError(
            f"{path} is truncated: its header says {vertex.count} vertices, but it holds "
            f"{available}; copy the file again."
        )
