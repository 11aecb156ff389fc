import numpy as np
import pytest
import trimesh

from nss_ros.errors import FormatError, InputError
from nss_ros.simulation.mesh_site import MeshArea, build_mesh_site
from nss_ros.simulation.site_file import areas, site_file_of


def floor():
    slab = trimesh.creation.box((10, 8, 0.2))
    slab.apply_translation((5, 4, -0.1))
    return slab


def post(x):
    solid = trimesh.creation.box((0.3, 0.3, 3.0))
    solid.apply_translation((x, 4, 1.5))
    return solid


@pytest.fixture
def folder(tmp_path):
    trimesh.util.concatenate([floor(), post(2)]).export(tmp_path / "first.ply")
    trimesh.util.concatenate([floor(), post(2), post(6)]).export(tmp_path / "second.stl")
    return tmp_path


def test_what_is_the_same_at_two_stages_is_one_element(folder):
    site = build_mesh_site("A", MeshArea(stages=["first.ply", "second.stl"]), folder)
    assert site.stages == 2
    assert sorted(sorted(element.stages) for element in site.elements) == [[1, 2], [1, 2], [2]]
    new = next(element for element in site.elements if element.stages == {2})
    assert new.mesh.vertices[:, 0].min() == pytest.approx(5.85)
    assert site.floor_height == pytest.approx(0.0, abs=1e-6)
    assert (site.extent.x0, site.extent.y1) == (0.0, 8.0)
    assert set(site.source["sha256"]) == {"first.ply", "second.stl"}


def test_a_scene_keeps_its_geometries_and_their_places(tmp_path):
    scene = trimesh.Scene()
    scene.add_geometry(floor())
    place = np.eye(4)
    place[:3, 3] = (1, 0, 0)
    scene.add_geometry(post(2), transform=place)
    scene.export(tmp_path / "both.glb")
    site = build_mesh_site("A", MeshArea(stages=["both.glb"]), tmp_path)
    assert len(site.elements) == 2
    assert max(e.mesh.vertices[:, 2].max() for e in site.elements) == pytest.approx(3.0)
    thin = min(site.elements, key=lambda e: np.ptp(e.mesh.vertices[:, 0]))
    assert thin.mesh.vertices[:, 0].mean() == pytest.approx(3.0, abs=1e-5)


def test_units_and_the_axis_up_are_as_told(tmp_path):
    solid = floor()
    solid.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, (1, 0, 0)))
    solid.apply_scale(1000)
    solid.export(tmp_path / "millimetres.obj")
    area = MeshArea(stages=["millimetres.obj"], scale=0.001, up="y")
    (element,) = build_mesh_site("A", area, tmp_path).elements
    low, high = element.mesh.vertices.min(axis=0), element.mesh.vertices.max(axis=0)
    np.testing.assert_allclose(low, (0, 0, -0.2), atol=1e-6)
    np.testing.assert_allclose(high, (10, 8, 0), atol=1e-6)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"nothing of the kind", "cannot be read as a mesh"),
        (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\n"
         b"property float z\nend_header\n0 0 0\n", "holds no triangles"),
    ],
)  # fmt: skip
def test_a_file_that_is_no_mesh_is_named(tmp_path, content, message):
    (tmp_path / "broken.ply").write_bytes(content)
    with pytest.raises(FormatError, match=rf"broken\.ply.*{message}"):
        build_mesh_site("A", MeshArea(stages=["broken.ply"]), tmp_path)


def test_missing_files_and_names_are_refused(folder):
    with pytest.raises(InputError, match=r"third\.ply"):
        build_mesh_site("A", MeshArea(stages=["third.ply"]), folder)
    area = MeshArea(stages=["first.ply", "second.stl"], names=["shell"])
    with pytest.raises(InputError, match="2 stages, but 1 names"):
        build_mesh_site("A", area, folder)


def test_a_mesh_without_floor_needs_its_height(tmp_path):
    vertices = [(0, 0, 0), (1, 0, 0), (0, 0, 1)]
    trimesh.Trimesh(vertices, [(0, 1, 2)]).export(tmp_path / "wall.ply")
    with pytest.raises(InputError, match="floor_height"):
        build_mesh_site("A", MeshArea(stages=["wall.ply"]), tmp_path)
    site = build_mesh_site("A", MeshArea(stages=["wall.ply"], floor_height=1.5), tmp_path)
    assert site.floor_height == 1.5


def test_things_lie_about_if_asked_for(folder):
    files = ["first.ply", "second.stl"]
    bare = build_mesh_site("A", MeshArea(stages=files), folder, seed=1)
    assert len(bare.elements) == 3
    area = MeshArea(stages=files, clutter=3.0)
    one, again, other = (build_mesh_site("A", area, folder, seed) for seed in (1, 1, 2))
    assert one.source["clutter"] == len(one.elements) - 3 > 0
    assert [element.name for element in one.elements] == [e.name for e in again.elements]
    assert [element.name for element in one.elements] != [e.name for e in other.elements]
    assert one.extent == bare.extent
    assert one.floor_height == bare.floor_height


def test_a_site_file_gives_meshes_a_seed_of_their_own(folder):
    (folder / "site.yaml").write_text(
        "areas:\n"
        "  '1': {meshes: {stages: [first.ply, second.stl], clutter: 3}}\n"
        "  '2': {meshes: {stages: [first.ply, second.stl], clutter: 3}}\n"
    )
    site_file, where = site_file_of([str(folder / "site.yaml")])
    one, two = (build() for _, build in areas(site_file, where, 4))
    assert one.source["clutter_seed"] != two.source["clutter_seed"]
    assert [element.name for element in one.elements] != [e.name for e in two.elements]
