import numpy as np

from nss_ros.simulation.element import Material
from nss_ros.simulation.mesh import box, merge
from nss_ros.simulation.scene import Scene

CUBES = merge([box((1, -1, -1), (2, 1, 1)), box((-3, -1, -1), (-2, 1, 1))])


def first_hits(mesh, origin, directions):
    """Distances in lengths of the directions, by Cramer's rule for every ray and triangle."""
    a, b, c = mesh.vertices[mesh.triangles].transpose(1, 0, 2)[:, None]
    columns = np.stack(np.broadcast_arrays(-directions[:, None], b - a, c - a), axis=-1)
    with np.errstate(all="ignore"):
        inverse = np.linalg.inv(columns + 1e-12 * np.eye(3))
        t, u, v = np.moveaxis((inverse @ (origin - a)[..., None])[..., 0], -1, 0)
    hit = (t > 0) & (u >= 0) & (v >= 0) & (u + v <= 1)
    return np.where(hit, t, np.inf).min(axis=1)


def test_hits_agree_with_brute_force():
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(300, 3))
    origin = np.array([0.1, 0.2, 0.3])
    hits = Scene(CUBES).cast(origin, directions)
    expected = first_hits(CUBES, origin, directions)
    np.testing.assert_allclose(hits.distances, expected, rtol=1e-4)
    assert 50 < np.isfinite(expected).sum() < 300


def test_materials_are_those_of_the_triangles():
    materials = np.repeat([Material.GLASS, Material.METAL], 12).astype(np.uint8)
    scene = Scene(CUBES, materials)
    hits = scene.cast(np.zeros(3), np.array([[1.0, 0, 0], [-1.0, 0, 0]]))
    assert scene.material_of(hits).tolist() == [Material.GLASS, Material.METAL]
    np.testing.assert_allclose(hits.distances, [1, 2], rtol=1e-6)


def test_an_empty_scene_has_no_hits():
    scene = Scene(merge([]))
    hits = scene.cast(np.zeros(3), np.eye(3))
    assert np.isinf(hits.distances).all()
    assert len(scene.material_of(hits)) == 3
