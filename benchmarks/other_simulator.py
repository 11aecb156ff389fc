"""A second simulator: a bag of a building model, staged and scanned by other code than ours.

    ./nss python benchmarks/other_simulator.py MODEL.ifc -o BAG [--floor Z] [--height H]
        [--spots N] [--scanner] [--seed N]
    ./nss map BAG -o LOG
    ./nss score LOG

What a method does on the sites of `nss simulate` may be what it learned of it. This one knows
nothing of trades, spots or a Matterport: floors, columns and stairs stand from the first stage on;
of the walls 45 % stand at the first stage, 80 % at the second and all at the third, inner ones and
facades alike, whichever chance picks; windows and everything else come later, doors never. Ten
boxes lie about, others at each stage. A sensor that turns about its axis stands 1.4 to 1.7 m above
the floor wherever chance puts it, also in rooms that are shut; it has 900 x 300 rays from 60
degrees below to 75 above the horizon, loses 5 % of them, sees 4.5 m far, with a range noise of
2 mm + 1.5 mm times the square of the distance, and is 0.4 degrees out of level. Points are thinned
to 6 cm. With --scanner it sees 30 m, more finely, with 4 mm of noise, and spots are farther apart.
Pairs are all that overlap by at least 0.1 within 0.2 m; doing so counts rooms on both sides of a
thin wall, between which nothing can be registered.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import ifcopenshell.geom
import numpy as np
import open3d as o3d
from scipy.ndimage import distance_transform_edt, label
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from nss_ros.bag import write_bag
from nss_ros.errors import NssError
from nss_ros.fragment import Fragment, FragmentId, FragmentPair
from nss_ros.multiway.pose_graph import Edge, EdgeKind, Node, NodeStatus, PoseGraph
from nss_ros.simulation.ifc_tessellation import open_ifc

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[np.float64]

SHELL = ("IfcSlab", "IfcColumn", "IfcBeam", "IfcStair", "IfcStairFlight", "IfcRoof")
NOT_BUILT = ("IfcSpace", "IfcOpeningElement", "IfcSite")
STAGES, NEVER = (1, 2, 3), 4
CELL, CLEARANCE, ROOM = 0.1, 0.4, 200
BOXES, CHOICE = 10, 60
TAU, MIN_OVERLAP = 0.2, 0.1
FEWEST_POINTS = 3000


class Sensor(NamedTuple):
    """What a scanner sees."""

    reach: float
    elevations: Array
    azimuths: int
    noise: tuple[float, float]
    voxel_size: float
    spacing: float


NEAR = Sensor(4.5, np.linspace(-60, 75, 300), 900, (0.002, 0.0015), 0.06, 1.8)
FAR = Sensor(30.0, np.linspace(-60, 85, 450), 1400, (0.004, 0.0), 0.05, 4.0)


class Element(NamedTuple):
    """A mesh that stands from some stage on."""

    vertices: Array
    triangles: NDArray[np.int64]
    kind: str = ""


class Scan(NamedTuple):
    """Points in the frame of the sensor, and where that is."""

    id: FragmentId
    points: Array
    pose: Array


def main() -> None:
    """Write a bag."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True, help="bag to write")
    parser.add_argument("--floor", type=float, default=0.0, help="height of the floor, metres")
    parser.add_argument("--height", type=float, default=2.8, help="of the storey, metres")
    parser.add_argument("--spots", type=int, default=16, help="of each stage")
    parser.add_argument("--scanner", action="store_true", help="that sees 30 m")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    rng = np.random.default_rng(arguments.seed)
    try:
        elements = elements_of(arguments.model, arguments.floor, arguments.height)
    except NssError as error:
        sys.exit(f"error: {error}")
    if not elements:
        sys.exit(f"error: {arguments.model} has no elements at {arguments.floor} m; see --floor.")
    sensor = FAR if arguments.scanner else NEAR
    scans = scanned(elements, sensor, arguments.floor, arguments.spots, rng)
    graph = PoseGraph(
        tuple(Node(scan.id, scan.pose, NodeStatus.PLACED) for scan in scans),
        tuple(edges_of(scans, 2 * sensor.reach)),
        name=arguments.model.stem,
    )
    fragments = [Fragment(each.id, each.points.astype(np.float32), True) for each in scans]
    try:
        write_bag(arguments.output, fragments, [edge.pair for edge in graph.edges], [graph])
    except NssError as error:
        sys.exit(f"error: {error}")
    print(f"{len(scans)} fragments, {len(graph.edges)} pairs: {arguments.output}")


def elements_of(path: Path, floor: float, height: float) -> list[Element]:
    """What a building model has about a storey."""
    settings = ifcopenshell.geom.settings()
    settings.set("use-world-coords", True)
    found = []
    model = open_ifc(path)  # its elements do not live longer than it does
    for product in model.by_type("IfcProduct"):
        if not product.Representation or any(map(product.is_a, NOT_BUILT)):
            continue
        try:
            geometry = ifcopenshell.geom.create_shape(settings, product).geometry
        except RuntimeError:
            continue
        vertices = np.array(geometry.verts, dtype=np.float64).reshape(-1, 3)
        triangles = np.array(geometry.faces, dtype=np.int64).reshape(-1, 3)
        heights = vertices[:, 2]
        if len(triangles) and heights.max() > floor - 0.5 and heights.min() < floor + height + 0.4:
            found.append(Element(vertices, triangles, product.is_a()))
    return found


def stage_of(kind: str, chance: float) -> int:
    """From which stage on an element stands."""
    if kind in SHELL:
        return 1
    if kind.startswith("IfcWall"):
        return 1 if chance < 0.45 else 2 if chance < 0.8 else 3
    if kind == "IfcWindow":
        return 2 if chance < 0.6 else 3
    return NEVER if kind == "IfcDoor" else 3


class Floor:
    """Places on a storey where one can stand."""

    def __init__(self, elements: list[Element], height: float) -> None:
        corners = np.concatenate([element.vertices[:, :2] for element in elements])
        self.low = corners.min(axis=0) - 0.5
        shape = np.ceil((corners.max(axis=0) + 0.5 - self.low) / CELL).astype(int)
        self.shape, self.height = (int(shape[0]), int(shape[1])), height
        numbers = np.stack(np.meshgrid(*map(np.arange, self.shape), indexing="ij"), axis=-1)
        self.cells = (self.low + (numbers + 0.5) * CELL).reshape(-1, 2)
        angles = np.radians(np.arange(0, 360, 15))
        whole = scene(elements)
        rays = [(np.cos(a), np.sin(a), 0.3) for a in angles]
        walled = [self._cast(whole, 1.4, ray) < 70 for ray in rays]
        self._inside = (np.mean(walled, axis=0) > 0.9).reshape(self.shape)

    def free(self, elements: list[Element]) -> NDArray[np.intp]:
        """Cells (n, 2) with floor below and a ceiling above, away from what stands about."""
        there = scene(elements)
        down, up = (self._cast(there, 1.9, (0, 0, z)) for z in (-1, 1))
        open_ = ((np.abs(down - 1.9) < 0.2) & (up < 4)).reshape(self.shape)
        rooms, _ = label(distance_transform_edt(open_) * CELL > CLEARANCE)
        sizes = np.bincount(rooms.ravel())
        sizes[0] = 0
        return np.argwhere(np.isin(rooms, np.flatnonzero(sizes > ROOM)) & self._inside)

    def _cast(self, there: o3d.t.geometry.RaycastingScene, above: float, ray: object) -> Array:
        origins = np.c_[self.cells, np.full(len(self.cells), self.height + above)]
        return cast(there, origins, np.tile(np.array(ray, dtype=np.float64), (len(origins), 1)))


def scanned(
    elements: list[Element], sensor: Sensor, height: float, spots: int, rng: np.random.Generator
) -> list[Scan]:
    """The scans of all stages, which begin about the same place."""
    stages = [stage_of(element.kind, rng.random()) for element in elements]
    floor = Floor(elements, height)
    first: Array | None = None
    scans = []
    for stage in STAGES:
        there = [element for element, since in zip(elements, stages, strict=True) if since <= stage]
        free = floor.free(there)
        if len(free) == 0:
            sys.exit(f"error: there is no free floor at {height} m at stage {stage}; see --floor.")
        for _ in range(BOXES):
            place = free[rng.integers(len(free))] * CELL + floor.low
            size = rng.uniform((0.3, 0.3, 0.3), (1.5, 1.0, 1.6))
            there.append(box((*place, height), size, rng.uniform(0, 3)))
        places = floor.free(there) * CELL + floor.low
        if first is None:
            first = places[rng.integers(len(places))]
        for spot, place in enumerate(spots_of(places, first, spots, sensor.spacing, rng)):
            id_ = FragmentId("A", stage, spot)
            scan = scan_of(id_, scene(there), sensor, (*place, height), rng)
            if len(scan.points) >= FEWEST_POINTS:  # else it stands inside of something
                scans.append(scan)
    return scans


def spots_of(
    places: Array, first: Array, count: int, spacing: float, rng: np.random.Generator
) -> list[Array]:
    """Places apart from each other, among the nearest that are left."""
    order = np.argsort(np.linalg.norm(places - first, axis=1))
    chosen: list[Array] = []
    while len(chosen) < count:
        apart = np.ones(len(places), dtype=bool)
        for place in chosen:
            apart &= np.linalg.norm(places - place, axis=1) > spacing
        left = order[apart[order]]
        if len(left) == 0:
            spacing *= 0.8
            continue
        chosen.append(places[left[min(len(left) - 1, rng.integers(CHOICE))]])
    return chosen


def scan_of(
    id_: FragmentId,
    there: o3d.t.geometry.RaycastingScene,
    sensor: Sensor,
    place: tuple[float, ...],
    rng: np.random.Generator,
) -> Scan:
    """What is seen from a place on the floor."""
    heading, tilt = rng.uniform(0, 2 * np.pi), np.radians(rng.normal(0, 0.4, 2))
    turn = Rotation.from_euler("z", heading) * Rotation.from_rotvec([*tilt, 0])
    pose = np.eye(4)
    pose[:3, :3] = turn.as_matrix()
    pose[:3, 3] = (*place[:2], place[2] + rng.uniform(1.4, 1.7))
    elevation, azimuth = np.meshgrid(
        np.radians(sensor.elevations),
        np.radians(np.linspace(0, 360, sensor.azimuths, endpoint=False)),
        indexing="ij",
    )
    flat = np.cos(elevation)
    rays = np.stack((flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)), axis=-1)
    rays = rays.reshape(-1, 3)
    origins = np.tile(pose[:3, 3], (len(rays), 1))
    ranges = cast(there, origins, rays @ pose[:3, :3].T)
    seen = (ranges < sensor.reach) & (ranges > 0.3) & (rng.random(len(ranges)) > 0.05)
    noise = rng.normal(0, 1, len(ranges))[seen]
    ranges = ranges[seen]
    ranges = ranges + noise * (sensor.noise[0] + sensor.noise[1] * ranges**2)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(rays[seen] * ranges[:, None]))
    thinned = np.asarray(cloud.voxel_down_sample(sensor.voxel_size).points)
    return Scan(id_, thinned.reshape(-1, 3), pose)


def edges_of(scans: list[Scan], farthest: float) -> list[Edge]:
    """The pairs of scans that overlap."""
    clouds = [scan.points @ scan.pose[:3, :3].T + scan.pose[:3, 3] for scan in scans]
    trees = [cKDTree(cloud) for cloud in clouds]
    edges = []
    for one, target in enumerate(scans):
        for other in range(one + 1, len(scans)):
            source = scans[other]
            if np.linalg.norm(target.pose[:3, 3] - source.pose[:3, 3]) > farthest:
                continue
            overlap = min(
                float(np.mean(trees[a].query(clouds[b], distance_upper_bound=TAU)[0] < TAU))
                for a, b in ((one, other), (other, one))
            )
            if overlap < MIN_OVERLAP:
                continue
            same = target.id.stage == source.id.stage
            kind = EdgeKind.SAME_STAGE if same else EdgeKind.DIFFERENT_STAGE
            truth = np.linalg.inv(target.pose) @ source.pose
            pair = FragmentPair(source=source.id, target=target.id)
            edges.append(Edge(pair, truth, kind, overlap_ratio=overlap))
    return edges


def box(place: tuple[float, ...], size: Array, yaw: float) -> Element:
    """A box on the floor."""
    mesh = o3d.geometry.TriangleMesh.create_box(*size)
    mesh.translate([-size[0] / 2, -size[1] / 2, 0])
    turn = Rotation.from_euler("z", yaw).as_matrix()
    vertices = np.asarray(mesh.vertices) @ turn.T + place
    return Element(vertices, np.asarray(mesh.triangles).astype(np.int64))


def scene(elements: list[Element]) -> o3d.t.geometry.RaycastingScene:
    """Elements, to cast rays at."""
    made = o3d.t.geometry.RaycastingScene()
    for element in elements:
        made.add_triangles(
            o3d.core.Tensor(element.vertices.astype(np.float32)),
            o3d.core.Tensor(element.triangles.astype(np.uint32)),
        )
    return made


def cast(there: o3d.t.geometry.RaycastingScene, origins: Array, directions: Array) -> Array:
    """How far rays go, infinite where they meet nothing."""
    rays = np.concatenate((origins, directions), axis=1).astype(np.float32)
    return np.asarray(there.cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy(), dtype=np.float64)


if __name__ == "__main__":
    main()
