"""Features of fragments, in memory up to a limit, else on disk: computed once for all processes.

The folder is shared by the processes that register pairs. It holds fragments and what methods
made of them, and no ground truth. Methods get to see fragments from where their scanners stood;
answers are for the frames that the fragments came in.
"""

from __future__ import annotations

import os
import pickle
from collections import OrderedDict
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

from nss_ros.config import RegistrationConfig
from nss_ros.fragment import Fragment, FragmentId, FragmentPair, voxelize
from nss_ros.geometry import Transform
from nss_ros.registration.method import Method
from nss_ros.registration.pair import register_pair
from nss_ros.registration.relative_transform import (
    Reason,
    RelativeTransform,
    failed,
    from_standpoints,
)
from nss_ros.standpoint import Standpoints, at_standpoint

_FEATURES = ".seen"


def fragment_file(folder: Path, fragment: FragmentId) -> Path:
    """Where a folder keeps a voxelised fragment."""
    return folder / f"{fragment}.fragment"


def feature_file(folder: Path, fragment: FragmentId) -> Path:
    """Where a folder keeps the features of a fragment."""
    return folder / f"{fragment}{_FEATURES}"


def forget_features(folder: Path) -> None:
    """Remove the features of all fragments, but not the fragments."""
    for path in folder.glob(f"*{_FEATURES}"):
        path.unlink()


def store_fragment(folder: Path, fragment: Fragment, voxel_size: float) -> None:
    """Voxelise a fragment into a folder; `voxel_size` in metres."""
    points = voxelize(fragment.points, voxel_size)
    _save(
        fragment_file(folder, fragment.id), Fragment(fragment.id, points, fragment.gravity_aligned)
    )


class Prepared(NamedTuple):
    """What a method made of a fragment as seen from its standpoint (4, 4), and that."""

    features: Any
    standpoint: Transform


class Preparation(NamedTuple):
    """That a fragment was prepared.

    Attributes:
        fragment: its id.
        seconds: how long it took; NaN if it failed.
        standpoint: (4, 4) pose of where its scanner stood in the frame that it came in; None if
            preparing it failed.
    """

    fragment: FragmentId
    seconds: float = float("nan")
    standpoint: Transform | None = None

    @property
    def warning(self) -> str:
        """Says so if the scanner stood elsewhere than at the origin; else empty."""
        if self.standpoint is None or not self.standpoint[:3, 3].any():
            return ""
        x, y, z = self.standpoint[:3, 3]
        return (
            f"The origin of fragment {self.fragment} cannot be the place of its scanner, which is "
            f"taken to be ({x:.1f}, {y:.1f}, {z:.1f}) by what it saw. If origins are the scanner's "
            "places, set find_standpoints of registration and pose_graph to false."
        )


class FeatureStore:
    """Features by fragment, for one process: from memory, from disk, or computed.

    Args:
        method: the registration method.
        fragments: folder that `store_fragment` filled.
        features: folder of this method's features; may be the same.
        limit: bytes kept in memory; the features used last stay.
        find_standpoints: whether origins that cannot be the scanner's place are replaced.
    """

    def __init__(
        self,
        method: Method,
        fragments: Path,
        features: Path,
        limit: int,
        find_standpoints: bool = True,
    ) -> None:
        self.method = method
        self._fragments, self._features = fragments, features
        self._limit = limit
        self._find_standpoints = find_standpoints
        self._size = 0
        self._entries: OrderedDict[FragmentId, tuple[Prepared, int]] = OrderedDict()

    def get(self, id_: FragmentId) -> Prepared:
        """The features of a fragment.

        Raises:
            OSError: the fragment was never stored, or the folder cannot be written.
            Exception: whatever the method raises.
        """
        if id_ in self._entries:
            self._entries.move_to_end(id_)
            return self._entries[id_][0]
        path = feature_file(self._features, id_)
        if path.exists():
            data = path.read_bytes()
            prepared: Prepared = pickle.loads(data)
            size = len(data)
        else:
            fragment = pickle.loads(fragment_file(self._fragments, id_).read_bytes())
            seen, place = at_standpoint(fragment, self._find_standpoints)
            prepared = Prepared(self.method.prepare(seen), place)
            size = _save(path, prepared)
        self._entries[id_] = (prepared, size)
        self._size += size
        while self._size > self._limit and len(self._entries) > 2:
            self._size -= self._entries.popitem(last=False)[1][1]
        return prepared

    def prepare(self, id_: FragmentId) -> Preparation:
        """Have a fragment's features computed.

        A pair that needs them tries again where that failed, and reports the error.
        """
        begin = perf_counter()
        try:
            prepared = self.get(id_)
        except Exception:
            return Preparation(id_)
        return Preparation(id_, perf_counter() - begin, prepared.standpoint)

    def register(self, pair: FragmentPair, config: RegistrationConfig) -> RelativeTransform:
        """The answer to a pair; never raises."""
        try:
            source, target = self.get(pair.source), self.get(pair.target)
        except Exception as error:
            message = f"Features could not be computed: {error}"
            return failed(pair, config.method, Reason.METHOD_ERROR, message)
        answer = register_pair(self.method, source.features, target.features, pair, config)
        return from_standpoints(answer, Standpoints(source.standpoint, target.standpoint))


def _save(path: Path, value: Any) -> int:
    """Pickle to a file that appears whole, so that workers may race; the size in bytes."""
    data = pickle.dumps(value, protocol=pickle.HIGHEST_PROTOCOL)
    temporary = path.with_suffix(f".{os.getpid()}")
    temporary.write_bytes(data)
    temporary.replace(path)
    return len(data)
