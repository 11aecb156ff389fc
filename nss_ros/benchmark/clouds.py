"""Point clouds by name, with what scoring computes from them more than once."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from nss_ros.benchmark.metrics import Floats, correspondences
from nss_ros.dataset.challenge_folder import find_points
from nss_ros.dataset.ply import read_ply
from nss_ros.errors import FormatError, InputError
from nss_ros.geometry import Transform


class Clouds:
    """Point clouds and their search trees, each made once.

    Args:
        load: gives the points of a name, (n, 3) float64, finite.
    """

    def __init__(self, load: Callable[[str], Floats]) -> None:
        self._load = load
        self._points: dict[str, Floats] = {}
        self._trees: dict[str, cKDTree] = {}

    def points(self, name: str) -> Floats:
        """The points of a cloud, (n, 3) float64, metres."""
        if name not in self._points:
            self._points[name] = self._load(name)
        return self._points[name]

    def _tree(self, name: str) -> cKDTree:
        if name not in self._trees:
            self._trees[name] = cKDTree(self.points(name))
        return self._trees[name]

    def correspondences(
        self, source: str, target: str, T_target_source: Transform
    ) -> NDArray[np.intp]:
        """Indices (source, target) of points that coincide under the ground truth, (n, 2)."""
        return correspondences(self.points(source), self._tree(target), T_target_source)


def clouds_in(folder: Path) -> Clouds:
    """The point clouds of a folder of PLY files, named as in pose graphs.

    Raises:
        InputError: there is no such folder.
    """
    if not folder.is_dir():
        raise InputError(f"There is no folder of point clouds at {folder}.")

    def load(name: str) -> Floats:
        path = find_points(folder, name)
        if path is None:
            raise FormatError(f"The point cloud {name} is missing in {folder}.")
        points = read_ply(path)
        if len(points) == 0 or not np.isfinite(points).all():
            problem = "non-finite coordinates" if len(points) else "no points"
            raise FormatError(
                f"{path} has {problem}, so RMSE is not defined: replace it, or score without "
                "point clouds."
            )
        return points

    return Clouds(load)
