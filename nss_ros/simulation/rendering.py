"""Shaded views of a mesh that is cut open at a height, ray-cast with Open3D (Embree)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from nss_ros.simulation.mesh import Mesh
from nss_ros.simulation.scene import raycaster

Array = NDArray[np.float64]

SECTION_COLOUR = (0.16, 0.17, 0.20)
"""Of solids where they are cut."""

PATTERNS = 4
"""Of directions in which light is sampled: one for each sample of a pixel.

The same ones in every pixel, so that a plain surface has a plain colour: noise would be seen,
and would make files large.
"""

# Oblique to most walls, so that rays leave them soon.
_ACROSS = (np.array([0.89, 0.45, 0.0]), np.array([-0.45, 0.89, 0.0]))
_THICKEST = 1.2  # of what is drawn as cut, metres
_CHUNK = 200_000  # rays at once; the occlusion of each takes several more
_LIFT = 2e-3  # of rays that leave a surface, metres
_SUN = np.array([-0.45, -0.35, 0.82]) / np.linalg.norm([-0.45, -0.35, 0.82])
_SUN_SIZE = 0.025
_DIRECT_SHARE = 0.42
_OCCLUSION_RAYS = 8
_OCCLUSION_RADIUS = 1.5
_HAZE = 0.012  # light lost per metre of a ray
_GOLDEN_ANGLE = np.pi * (3 - np.sqrt(5))


class Renderer:
    """A mesh to be looked at, without what lies above a height.

    Args:
        mesh: map frame.
        colours: (m, 3) of the triangles, 0..1.
        cut: z above which there is nothing, metres; infinity keeps all.
    """

    def __init__(self, mesh: Mesh, colours: Array, cut: float = float("inf")) -> None:
        self._tensor, self._scene, self._offset = raycaster(mesh)
        self._colours = np.asarray(colours, dtype=np.float64)
        self._cut = cut

    def shade(
        self,
        origins: Array,
        directions: Array,
        patterns: NDArray[np.intp],
        background: Array,
        sun: bool = True,
    ) -> Array:
        """Colours of rays: direct light, ambient occlusion, a little haze.

        Where the cut goes through something solid, rays have the colour of a section.

        Args:
            origins: (n, 3) metres; above the cut, rays start where they meet it.
            directions: (n, 3) unit vectors.
            patterns: (n,) which sampling pattern each takes, 0 to `PATTERNS` - 1.
            background: (n, 3) colours where rays hit nothing.
            sun: direct light with soft shadows comes from above, else from the eye.

        Returns:
            (n, 3), 0..1.
        """
        image = np.array(background, dtype=np.float64)
        for start in range(0, len(origins), _CHUNK):
            part = slice(start, start + _CHUNK)
            self._shade(image[part], origins[part], directions[part], patterns[part], sun)
        return image

    def _shade(
        self,
        image: Array,
        origins: Array,
        directions: Array,
        patterns: NDArray[np.intp],
        sun: bool,
    ) -> None:
        starts, on_the_cut = self._below_the_cut(origins, directions)
        answer = self._scene.cast_rays(self._rays(starts, directions))
        distance = answer["t_hit"].numpy().astype(np.float64)
        hit = np.flatnonzero(np.isfinite(distance))
        normals = answer["primitive_normals"].numpy().astype(np.float64)[hit]
        directions, distance = directions[hit], distance[hit]
        points = starts[hit] + distance[:, None] * directions
        normals[np.einsum("ni,ni->n", normals, directions) > 0] *= -1
        points += _LIFT * normals
        direct = (
            self._sunlight(points, normals, patterns[hit])
            if sun
            else -np.einsum("ni,ni->n", normals, directions)
        )
        ambient = self._ambient(points, normals, patterns[hit])
        light = _DIRECT_SHARE * direct + (1 - _DIRECT_SHARE) * ambient
        light *= 1 - np.minimum(_HAZE * distance, 0.4)
        image[hit] = self._colours[answer["primitive_ids"].numpy()[hit]] * light[:, None]
        image[on_the_cut[self._solid(starts[on_the_cut])]] = SECTION_COLOUR

    def _below_the_cut(self, origins: Array, directions: Array) -> tuple[Array, NDArray[np.intp]]:
        """Where rays start, and which of them start on the cut."""
        above = np.flatnonzero((origins[:, 2] > self._cut) & (directions[:, 2] < 0))
        starts = np.array(origins)
        way = (self._cut - origins[above, 2]) / directions[above, 2]
        starts[above] += way[:, None] * directions[above]
        return starts, above

    def _solid(self, points: Array) -> NDArray[np.bool_]:
        """Whether points lie in something: most ways out lead through the back of a face.

        Not all do, because faces of things that touch coincide. Whole rooms of meshes whose
        faces are turned the wrong way are too thick to be taken for something solid.
        """
        backs = np.zeros(len(points), dtype=int)
        thickness = np.full(len(points), np.inf)
        for way in _ACROSS:
            width = np.zeros(len(points))
            for direction in (way, -way):
                rays = self._rays(points, np.broadcast_to(direction, points.shape))
                answer = self._scene.cast_rays(rays)
                backs += answer["primitive_normals"].numpy() @ direction > 0
                width += answer["t_hit"].numpy()
            thickness = np.minimum(thickness, width)
        return (backs >= 2) & (thickness < _THICKEST)

    def _sunlight(self, points: Array, normals: Array, patterns: NDArray[np.intp]) -> Array:
        angles = np.pi / 2 * patterns
        offsets = np.stack((np.cos(angles), np.sin(angles), np.zeros(len(points))), axis=1)
        towards = np.maximum(normals @ _SUN, 0.0)
        facing = np.flatnonzero(towards > 0)
        hidden = self._hidden(points[facing], _SUN + _SUN_SIZE * offsets[facing], np.inf)
        towards[facing[hidden]] = 0.0
        return np.asarray(towards)

    def _ambient(self, points: Array, normals: Array, patterns: NDArray[np.intp]) -> Array:
        free = np.zeros(len(points))
        for ray in range(_OCCLUSION_RAYS):
            directions = _hemisphere(normals, PATTERNS * ray + patterns)
            free += ~self._hidden(points, directions, _OCCLUSION_RADIUS)
        return np.asarray(0.25 + 0.75 * free / _OCCLUSION_RAYS)

    def _hidden(self, points: Array, directions: Array, radius: float) -> NDArray[np.bool_]:
        """Whether something below the cut lies within a radius (of unit directions)."""
        length = np.full(len(points), min(radius, 1e3))
        rising = directions[:, 2] > 1e-9
        clearance = np.maximum(self._cut - points[rising, 2], 1e-3)
        length[rising] = np.minimum(length[rising], clearance / directions[rising, 2])
        rays = self._rays(points, directions * length[:, None])
        return np.asarray(self._scene.test_occlusions(rays, 0.0, 1.0).numpy() > 0)

    def _rays(self, origins: Array, directions: Array) -> Any:
        return self._tensor(np.hstack((origins - self._offset, directions)).astype(np.float32))


def _hemisphere(normals: Array, sample: NDArray[np.intp]) -> Array:
    """Cosine-weighted directions about normals, (n, 3): a spiral of all samples of a pixel."""
    count = PATTERNS * _OCCLUSION_RAYS
    radius = np.sqrt((sample + 0.5) / count)
    angle = _GOLDEN_ANGLE * sample
    up = np.sqrt(1 - radius**2)
    # An orthonormal basis without a branch at the poles (Duff et al. 2017).
    x, y, z = normals.T
    sign = np.where(z >= 0, 1.0, -1.0)
    a = -1 / (sign + z)
    b = x * y * a
    first = np.stack((1 + sign * x * x * a, sign * b, -sign * x), axis=1)
    second = np.stack((b, sign + y * y * a, -y), axis=1)
    across = radius * np.cos(angle), radius * np.sin(angle)
    return np.asarray(
        across[0][:, None] * first + across[1][:, None] * second + up[:, None] * normals
    )
