import numpy as np
import pytest

from nss_ros.config import RigConfig
from nss_ros.geometry import from_yaw, tilt_angle, transform_points
from nss_ros.simulation.element import Material
from nss_ros.simulation.mesh import Mesh, box, merge
from nss_ros.simulation.rig import draw_pose, image_directions, image_rotations, scan
from nss_ros.simulation.scene import Scene

EXACT = RigConfig(
    axial_noise=0, disparity_step=0, lateral_noise=0, dropout=0, grazing_start=89.9, grazing_end=90
)
LOWER, UPPER = np.array([-2.0, -1.5, 0.0]), np.array([2.0, 2.5, 3.0])
POSE = from_yaw(0.7, (0.3, 0.2, 1.6))


@pytest.fixture(scope="module")
def room():
    """Six walls around an empty room."""
    thick = 0.1
    low, high = LOWER - thick, UPPER + thick
    slabs = []
    for axis in range(3):
        for inner, outer in ((LOWER, low), (UPPER, high)):
            a, b = low.copy(), high.copy()
            a[axis], b[axis] = sorted((inner[axis], outer[axis]))
            slabs.append(box(a, b))
    return Scene(merge(slabs))


def distance_from_walls(points):
    return np.abs(np.concatenate((points - LOWER, points - UPPER), axis=1)).min(axis=1)


def seen(scene, pose=POSE, config=EXACT, reach=None):
    return scan(scene, pose, config, np.random.default_rng(0), reach)


def test_an_exact_scan_lies_on_the_walls_in_the_sensor_frame(room):
    points = transform_points(POSE, scan(room, POSE, EXACT, np.random.default_rng(0)).points)
    assert len(points) > 0.9 * 18 * 160 * 120
    assert distance_from_walls(points).max() < 1e-4


def test_images_look_where_the_rig_says():
    directions = image_directions(RigConfig())
    angles = np.degrees(np.arctan(np.abs(directions[1:]).max(axis=1)))
    assert 28 < angles[0] < 29
    assert 22 < angles[1] < 22.5
    axes = image_rotations() @ [1.0, 0.0, 0.0]
    assert sorted(np.round(np.degrees(np.arcsin(axes[:, 2])))) == [-30] * 6 + [0] * 6 + [30] * 6
    azimuths = np.degrees(np.arctan2(axes[:, 1], axes[:, 0])) % 360
    assert sorted(np.round(azimuths) % 360) == sorted([0, 60, 120, 180, 240, 300] * 3)
    upright = image_rotations() @ [0.0, 0.0, 1.0]
    assert (upright[:, 2] > 0.8).all()


def test_the_field_of_view_leaves_the_poles_unseen(room):
    points = scan(room, POSE, EXACT, np.random.default_rng(0)).points
    elevation = np.degrees(np.arctan2(points[:, 2], np.linalg.norm(points[:, :2], axis=1)))
    # 30 + 22.5 degrees in the middle of an image, less towards its corners
    assert 45 < elevation.max() < 53
    assert -53 < elevation.min() < -45


def test_range_limits_hold(room):
    config = EXACT.model_copy(update={"min_range": 1.7, "max_range": 2.2})
    distances = np.linalg.norm(scan(room, POSE, config, np.random.default_rng(0)).points, axis=1)
    assert distances.min() >= 1.7 - 1e-4
    assert distances.max() <= 2.2 + 1e-4


def test_noise_grows_with_depth():
    config = RigConfig(dropout=0, max_range=10)
    spread = []
    for depth in (1.0, 2.0, 4.0):
        scene = Scene(box((depth, -10, -10), (depth + 1, 10, 10)))
        points = scan(scene, np.eye(4), config, np.random.default_rng(0)).points
        ahead = points[np.abs(points[:, 1:]).max(axis=1) < 0.4 * depth]
        assert ahead[:, 0].mean() == pytest.approx(depth, rel=0.005)
        spread.append(ahead[:, 0].std())
    # quadratic, and at least the configured axial noise
    assert spread[1] / spread[0] == pytest.approx(4, rel=0.4)
    assert spread[2] / spread[1] == pytest.approx(4, rel=0.4)
    assert spread[2] > config.axial_noise * 16


def test_depths_are_whole_steps_of_disparity():
    scene = Scene(box((3.0, -10, -10), (4.0, 10, 10)))
    config = RigConfig(lateral_noise=0)
    points = scan(scene, np.eye(4), config, np.random.default_rng(0)).points
    ahead = points[np.abs(points[:, 1:]).max(axis=1) < 0.3].astype(float)  # only the level image
    disparity = 1 / (ahead[:, 0] * config.disparity_step)
    assert np.abs(disparity - np.rint(disparity)).max() < 1e-3
    assert len(np.unique(np.rint(disparity))) > 3


def test_grazing_surfaces_give_fewer_returns():
    rng = np.random.default_rng(0)
    floor = Scene(box((-10, -10, -1), (10, 10, 0)))
    low = from_yaw(0.0, (0.0, 0.0, 0.3))
    config = EXACT.model_copy(update={"grazing_start": 70.0, "grazing_end": 85.0})
    points = scan(floor, low, config, rng).points
    incidence = np.degrees(np.arctan2(np.linalg.norm(points[:, :2], axis=1), 0.3))
    assert incidence.max() < 85.0
    everything = scan(floor, low, EXACT, rng).points
    kept = np.degrees(np.arctan2(np.linalg.norm(everything[:, :2], axis=1), 0.3))
    assert (incidence < 69).sum() == pytest.approx((kept < 69).sum(), rel=0.01)
    assert (incidence > 78).sum() < 0.5 * (kept > 78).sum()


def test_no_return_where_there_is_nothing():
    scene = Scene(box((100, 100, 100), (101, 101, 101)))
    assert scan(scene, POSE, RigConfig(), np.random.default_rng(0)).points.shape == (0, 3)


def test_tripods_stand_almost_level_at_any_heading():
    rng = np.random.default_rng(0)
    poses = [draw_pose((1.0, 2.0, 0.0), RigConfig(), rng) for _ in range(300)]
    heights = np.array([pose[2, 3] for pose in poses])
    assert heights.min() >= 1.5
    assert heights.max() <= 1.75
    assert all(np.array_equal(pose[:2, 3], [1.0, 2.0]) for pose in poses)
    tilts = np.degrees([tilt_angle(pose) for pose in poses])
    assert np.sqrt(np.mean(tilts**2)) == pytest.approx(0.5 * np.sqrt(2), rel=0.15)
    headings = np.arctan2([p[1, 0] for p in poses], [p[0, 0] for p in poses])
    assert np.histogram(headings, bins=4, range=(-np.pi, np.pi))[0].min() > 40


def test_materials_give_fewer_returns_where_they_should():
    wall = box((3.0, -10, -10), (4.0, 10, 10))
    config = EXACT.model_copy(update={"max_range": 10.0})

    def returns(material, changes=None):
        materials = np.full(len(wall.triangles), material, dtype=np.uint8)
        changed = config.model_copy(update=changes or {})
        return len(
            scan(Scene(wall, materials), np.eye(4), changed, np.random.default_rng(0)).points
        )

    matt = returns(Material.MATT)
    assert returns(Material.GLASS) == pytest.approx(config.glass_return * matt, rel=0.2)
    assert returns(Material.METAL) < 0.8 * matt
    assert returns(Material.DARK) < 0.5 * matt
    assert returns(Material.DARK, {"dark_range_start": 50.0, "dark_range_end": 60.0}) == matt


def test_normals_face_the_sensor_and_triangles_are_those_that_were_hit(room):
    returns = scan(room, POSE, EXACT, np.random.default_rng(0))
    assert (np.einsum("ij,ij->i", returns.normals, returns.points) < 0).all()
    np.testing.assert_allclose(np.linalg.norm(returns.normals, axis=1), 1, atol=1e-5)
    hit = room.mesh.vertices[room.mesh.triangles[returns.triangles]]
    normals = np.cross(hit[:, 1] - hit[:, 0], hit[:, 2] - hit[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    turned = returns.normals @ POSE[:3, :3].T
    np.testing.assert_allclose(np.abs(np.einsum("ij,ij->i", normals, turned)), 1, atol=1e-4)


def test_a_longer_reach_adds_points_and_changes_none(room):
    config = RigConfig(max_range=2.5)
    near, far = seen(room, config=config), seen(room, config=config, reach=10.0)
    assert len(far.points) > 1.2 * len(near.points)
    again = far.within(2.5)
    np.testing.assert_array_equal(again.points, near.points)
    np.testing.assert_array_equal(again.normals, near.normals)
    np.testing.assert_array_equal(again.triangles, near.triangles)


def test_a_site_in_a_national_grid_is_seen_as_sharply(room):
    offset = np.array([155_000.25, 463_000.5, 12.0])
    far = Scene(Mesh(room.mesh.vertices + offset, room.mesh.triangles))
    pose = POSE.copy()
    pose[:3, 3] += offset
    points = transform_points(pose, seen(far, pose).points)
    assert distance_from_walls(points - offset).max() < 1e-4


def test_normals_do_not_depend_on_which_way_the_mesh_is_wound():
    wall = box((2.0, -10, -10), (3.0, 10, 10))
    outward, inward = Scene(wall), Scene(Mesh(wall.vertices, wall.triangles[:, ::-1].copy()))
    np.testing.assert_array_equal(seen(outward, np.eye(4)).normals, seen(inward, np.eye(4)).normals)


def test_jitter_moves_depths_across_an_edge_but_not_pixels():
    edge = Scene(merge([box((2, -9, -9), (3, 0, 9)), box((4, -9, -9), (5, 9, 9))]))
    blur = EXACT.model_copy(update={"lateral_noise": 0.3})
    sharp, blurred = (seen(edge, np.eye(4), config).points for config in (EXACT, blur))
    # Of the level image straight ahead only.
    ahead = [p[(np.abs(p[:, 1:]) < np.outer(p[:, 0], (0.5, 0.1))).all(1)] for p in (sharp, blurred)]
    near = [points[points[:, 0] < 3] for points in ahead]
    assert near[0][:, 1].max() < 0.001
    assert 0.01 < near[1][:, 1].max() < 0.1
    assert np.allclose(near[1][:, 0], 2, atol=1e-4)
    width = RigConfig().image_width
    column = (near[1][:, 1] / near[1][:, 0] / np.tan(np.radians(29)) + 1) / 2 * width - 0.5
    assert np.abs(column - np.rint(column)).max() < 1e-2


def test_an_empty_scene_gives_nothing():
    returns = seen(Scene(merge([])))
    assert returns.points.shape == returns.normals.shape == (0, 3)
    assert returns.triangles.shape == returns.ranges.shape == (0,)
