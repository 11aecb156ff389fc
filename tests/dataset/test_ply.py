from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from nss_ros.dataset.ply import read_columns, read_ply, write_ply
from nss_ros.errors import FormatError

CUBE = np.array([[0.0, 0.5, 1.0], [1.25, -2.0, 3.0], [4.0, 5.0, -6.5]])


def ascii_ply(count: int, rows: str, properties: str = "xyz", kind: str = "float") -> str:
    lines = "".join(f"property {kind} {name}\n" for name in properties)
    return f"ply\nformat ascii 1.0\nelement vertex {count}\n{lines}end_header\n{rows}"


def binary_ply(
    dtype: np.dtype, table: np.ndarray, order: str = "little", before: str = ""
) -> bytes:
    names = {"f4": "float", "f8": "double", "u1": "uchar", "i2": "short"}
    properties = "".join(
        f"property {names[dtype[name].str[1:]]} {name}\n" for name in dtype.names or ()
    )
    header = (
        f"ply\nformat binary_{order}_endian 1.0\ncomment a scan\n{before}"
        f"element vertex {len(table)}\n{properties}end_header\n"
    )
    return header.encode() + table.tobytes()


def write(path: Path, content: str | bytes) -> Path:
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


@given(arrays(np.float32, st.tuples(st.integers(0, 30), st.just(3)), elements=st.floats(width=32)))
@settings(max_examples=40, deadline=None)
def test_what_is_written_is_read(tmp_path_factory, points):
    path = tmp_path_factory.mktemp("ply") / "cloud.ply"
    write_ply(path, {axis: points[:, i] for i, axis in enumerate("xyz")})
    np.testing.assert_array_equal(read_ply(path), points.astype(np.float64))


def test_header_decides_how_many_ascii_vertices(tmp_path):
    rows = "\n".join(" ".join(map(str, row)) for row in CUBE)
    np.testing.assert_array_equal(read_ply(write(tmp_path / "a.ply", ascii_ply(2, rows))), CUBE[:2])


def test_ascii_numbers_keep_their_digits(tmp_path):
    path = write(tmp_path / "a.ply", ascii_ply(1, "-0.6498775720582257 1e-9 nan\n"))
    np.testing.assert_array_equal(read_ply(path), [[-0.6498775720582257, 1e-9, np.nan]])


def test_windows_line_ends(tmp_path):
    text = ascii_ply(3, "\n".join(" ".join(map(str, row)) for row in CUBE) + "\n")
    path = write(tmp_path / "a.ply", text.replace("\n", "\r\n"))
    np.testing.assert_array_equal(read_ply(path), CUBE)


@pytest.mark.parametrize("order", ["little", "big"])
@pytest.mark.parametrize("kind", ["f4", "f8"])
def test_binary_with_extra_properties_in_any_order(tmp_path, order, kind):
    sign = "<" if order == "little" else ">"
    dtype = np.dtype(
        [("red", sign + "u1"), ("z", sign + kind), ("x", sign + kind), ("nx", sign + "f4"),
         ("y", sign + kind)]
    )  # fmt: skip
    table = np.zeros(3, dtype)
    for i, axis in enumerate("xyz"):
        table[axis] = CUBE[:, i]
    path = write(tmp_path / "a.ply", binary_ply(dtype, table, order))
    np.testing.assert_array_equal(read_ply(path), CUBE)


def test_an_element_before_the_vertices_is_skipped(tmp_path):
    dtype = np.dtype([(axis, "<f4") for axis in "xyz"])
    table = np.zeros(3, dtype)
    for i, axis in enumerate("xyz"):
        table[axis] = CUBE[:, i]
    content = binary_ply(dtype, table, before="element camera 2\nproperty short fov\n")
    end = content.index(b"end_header\n") + len(b"end_header\n")
    path = write(tmp_path / "a.ply", content[:end] + b"\x01\x02\x03\x04" + content[end:])
    np.testing.assert_array_equal(read_ply(path), CUBE)


def test_open3d_reads_the_same(tmp_path):
    o3d = pytest.importorskip("open3d")
    points = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    path = tmp_path / "cloud.ply"
    stage = np.full(50, 3, dtype=np.int32)
    write_ply(path, {**{axis: points[:, i] for i, axis in enumerate("xyz")}, "stage": stage})
    cloud = o3d.io.read_point_cloud(str(path))
    np.testing.assert_array_equal(np.asarray(cloud.points), points.astype(np.float64))
    o3d.io.write_point_cloud(str(path), cloud)
    np.testing.assert_array_equal(read_ply(path), np.asarray(cloud.points))


def test_no_points_and_one_point(tmp_path):
    assert read_ply(write(tmp_path / "a.ply", ascii_ply(0, ""))).shape == (0, 3)
    assert read_ply(write(tmp_path / "b.ply", ascii_ply(1, "1 2 3"))).shape == (1, 3)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("", "first line must be 'ply'"),
        ("solid cube\n", "first line must be 'ply'"),
        ("ply\nformat ascii 1.0\nelement vertex 3\n", "header of .* does not end"),
        ("ply\nelement vertex 0\nend_header\n", "no 'format' line"),
        ("ply\nformat ascii 1.0\nelement vertex -3\nend_header\n", "element vertex -3"),
        ("ply\nformat ascii 1.0\nelement vertex many\nend_header\n", "element vertex many"),
        ("ply\nformat ascii 1.0\nelement vertex 1\nproperty half x\nend_header\n", "half x"),
        ("ply\nformat ascii 1.0\nelement face 0\nend_header\n", "no 'vertex' element"),
        (ascii_ply(1, "1 2", "xy"), "no property 'z'"),
        (ascii_ply(1, "1 2 3 4", "xyzx"), "repeated property"),
        (ascii_ply(3, "1 2 3\n4 5 6\n"), "truncated: its header says 3 vertices, but it holds 2"),
        (ascii_ply(2, "1 2 3\n4 5\n"), "does not have 3 numbers"),
        (ascii_ply(1, "1 2 three\n"), "not a number"),
        (ascii_ply(10**15, "1 2 3\n"), "truncated"),
    ],
)
def test_damaged_files(tmp_path, content, words):
    with pytest.raises(FormatError, match=words):
        read_ply(write(tmp_path / "a.ply", content))


@given(cut=st.integers(0, 200))
@settings(max_examples=60, deadline=None)
def test_a_truncated_binary_is_never_read(tmp_path_factory, cut):
    path = tmp_path_factory.mktemp("ply") / "a.ply"
    write_ply(path, {axis: CUBE[:, i] for i, axis in enumerate("xyz")})
    content = path.read_bytes()
    path.write_bytes(content[: min(cut, len(content) - 1)])
    with pytest.raises(FormatError):
        read_ply(path)


def test_missing_file_and_folder(tmp_path):
    with pytest.raises(FormatError, match="Cannot read point cloud"):
        read_ply(tmp_path / "none.ply")
    with pytest.raises(FormatError, match="Cannot read point cloud"):
        read_ply(tmp_path)


def test_all_columns_come_back_in_their_types(tmp_path):
    columns = {axis: CUBE[:, i].astype(np.float32) for i, axis in enumerate("xyz")}
    columns |= {
        "element": np.array([3, -1, 7], np.int32),
        "change": np.array([0, 255, 2], np.uint8),
    }
    path = tmp_path / "a.ply"
    write_ply(path, columns)
    read = read_columns(path)
    assert list(read) == list(columns)
    for name, column in columns.items():
        assert read[name].dtype == column.dtype
        np.testing.assert_array_equal(read[name], column)
