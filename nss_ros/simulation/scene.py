"""Ray casting and distances against a mesh, by Open3D's RaycastingScene (Embree)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nss_ros.simulation.mesh import Mesh


class Scene:
    """A mesh to be looked at.

    Args:
        mesh: in the frame of all rays and points.
    """

    def __init__(self, mesh: Mesh) -> None:
        import open3d as o3d  # costs seconds

        self._tensor = o3d.core.Tensor.from_numpy
        self._scene = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(
            self._tensor(mesh.vertices.astype(np.float32)),
            self._tensor(mesh.triangles.astype(np.uint32)),
        )

    def cast(
        self, origins: NDArray[np.floating], directions: NDArray[np.floating]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """What rays hit first.

        Args:
            origins: (n, 3) or (3,), metres.
            directions: (n, 3) of any length but zero.

        Returns:
            Distances (n,) in lengths of the directions, inf without a hit, and the unit
            normals (n, 3) of the triangles, zero without a hit.
        """
        rays = np.empty((len(directions), 6), dtype=np.float32)
        rays[:, :3] = origins
        rays[:, 3:] = directions
        answer = self._scene.cast_rays(self._tensor(rays))
        distances = np.asarray(answer["t_hit"].numpy(), dtype=np.float64)
        return distances, np.asarray(answer["primitive_normals"].numpy(), dtype=np.float64)

    def distance(self, points: NDArray[np.floating]) -> NDArray[np.float64]:
        """Distance of points (n, 3) from the nearest surface, (n,) metres."""
        queries = self._tensor(np.ascontiguousarray(points, dtype=np.float32))
        return np.asarray(self._scene.compute_distance(queries).numpy(), dtype=np.float64)
