"""`poses.jsonl`: ground-truth poses, one JSON object per line, appended as fragments are made.

A line is `{"id": "Bldg1_Stage2_Spot14", "T_map_fragment": [4 rows of 4 numbers]}`. What was
appended survives the process; a last line that a kill cut short is not counted.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from nss_ros.errors import FormatError, InputError
from nss_ros.files import write_file
from nss_ros.fragment import FragmentId
from nss_ros.geometry import Transform, is_transform


def read_poses(path: Path) -> dict[FragmentId, Transform]:
    """The poses `T_map_fragment` of a file, in canonical order.

    Raises:
        FormatError: the file cannot be read, or a line is not valid.
    """
    try:
        lines = path.read_bytes().split(b"\n")
    except OSError as error:
        raise FormatError(f"Cannot read the poses {path}: {error.strerror}.") from error
    # What follows the last line end was cut short, or is empty.
    poses = dict(_pose(line, f"{path}, line {i}") for i, line in enumerate(lines[:-1], start=1))
    return dict(sorted(poses.items()))


def write_poses(path: Path, poses: Mapping[FragmentId, Transform]) -> None:
    """Write poses `T_map_fragment` in canonical order, whole or not at all.

    Raises:
        FormatError: the file cannot be written.
    """
    write_file(path, b"".join(_line(fragment, poses[fragment]) for fragment in sorted(poses)))


def append_pose(path: Path, fragment: FragmentId, T_map_fragment: Transform) -> None:
    """Add one pose to the end of a file.

    Raises:
        FormatError: the file cannot be written.
    """
    try:
        with path.open("ab") as file:
            file.write(_line(fragment, T_map_fragment))
    except OSError as error:
        raise FormatError(f"Cannot write {path}: {error.strerror}.") from error


def _line(fragment: FragmentId, pose: Transform) -> bytes:
    return (json.dumps({"id": str(fragment), "T_map_fragment": pose.tolist()}) + "\n").encode()


def _pose(line: bytes, place: str) -> tuple[FragmentId, Transform]:
    try:
        data = json.loads(line)
        fragment = FragmentId.parse(str(data["id"]))
        pose = np.array(data["T_map_fragment"], dtype=np.float64)
        if is_transform(pose):
            return fragment, pose
    except (ValueError, TypeError, KeyError, RecursionError, InputError):
        pass
    raise FormatError(
        f"{place} is not a pose: expected an object with 'id' and a rigid 4x4 'T_map_fragment'; "
        "remove the line, or make the dataset again."
    )
