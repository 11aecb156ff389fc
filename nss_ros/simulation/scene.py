"""Ray casting against a mesh, by Open3D's RaycastingScene (Embree)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nss_ros.simulation.element import Material
from nss_ros.simulation.mesh import Mesh


@dataclass(frozen=True, slots=True)
class Hits:
    """What n rays hit first.

    Attributes:
        distances: (n,) float32 in lengths of the rays' directions; inf without a hit.
        normals: (n, 3) float32 unit normals of the triangles, either way; zero without a hit.
        triangles: (n,) uint32 indices; 2**32 - 1 without a hit.
    """

    distances: NDArray[np.float32]
    normals: NDArray[np.float32]
    triangles: NDArray[np.uint32]


def raycaster(mesh: Mesh) -> tuple[Any, Any, NDArray[np.float64]]:
    """What casts rays against a mesh, one that may be empty.

    Built by one thread: else the number of threads decides among coincident surfaces.

    Returns:
        What makes tensors of arrays, the RaycastingScene, and the origin (3,) of its coordinates
        in the mesh's frame: Embree is of single precision, so sites in a national grid are moved.
    """
    import open3d as o3d  # costs seconds

    tensor = o3d.core.Tensor.from_numpy
    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    offset = np.zeros(3)
    if len(mesh.triangles):
        used = mesh.vertices[np.unique(mesh.triangles)]
        offset = np.rint((used.min(axis=0) + used.max(axis=0)) / 2)
        scene.add_triangles(
            tensor((mesh.vertices - offset).astype(np.float32)),
            tensor(mesh.triangles.astype(np.uint32)),
        )
    return tensor, scene, offset


class Scene:
    """A mesh to be looked at.

    One thread builds it and casts: among coincident surfaces, which one is hit would depend on
    the number of threads otherwise, and many spots are simulated at a time anyway.

    Args:
        mesh: in the frame of all rays and points; may be empty.
        materials: (m,) uint8 `Material` per triangle; all are matt if missing.

    Attributes:
        mesh: as given.
        materials: as given.
    """

    def __init__(self, mesh: Mesh, materials: NDArray[np.uint8] | None = None) -> None:
        matt = np.full(len(mesh.triangles), Material.MATT, dtype=np.uint8)
        self.mesh = mesh
        self.materials = matt if materials is None else materials
        self._tensor, self._scene, self._offset = raycaster(mesh)

    def cast(self, origins: NDArray[np.floating], directions: NDArray[np.floating]) -> Hits:
        """What rays hit first.

        Args:
            origins: (n, 3) or (3,), metres.
            directions: (n, 3) of any length but zero.
        """
        rays = np.empty((len(directions), 6), dtype=np.float32)
        starts = np.asarray(origins - self._offset)
        for axis in range(3):  # numpy is slow along short rows
            rays[:, axis] = starts[..., axis]
            rays[:, 3 + axis] = directions[:, axis]
        answer = self._scene.cast_rays(self._tensor(rays), nthreads=1)
        return Hits(
            answer["t_hit"].numpy(),
            answer["primitive_normals"].numpy(),
            answer["primitive_ids"].numpy(),
        )

    def material_of(self, hits: Hits) -> NDArray[np.uint8]:
        """`Material` (n,) of the triangles that rays hit; without a hit, of any."""
        if len(self.materials) == 0:
            return np.full(len(hits.triangles), Material.MATT, dtype=np.uint8)
        return np.asarray(self.materials.take(hits.triangles, mode="clip"))
