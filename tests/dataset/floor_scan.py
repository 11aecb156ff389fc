"""A made-up floor in two stages, scanned from many spots: a dataset that takes no ray caster."""

import numpy as np

from nss_ros.dataset.folder import FragmentColumns
from nss_ros.dataset.manifest import Manifest
from nss_ros.dataset.site_record import SiteRecord
from nss_ros.dataset.writer import DatasetWriter
from nss_ros.fragment import FragmentId
from nss_ros.geometry import from_yaw, inverse, transform_points

RANGE = 4.5
SIZE = np.array((24.0, 9.0))

# Boxes (low, high) with their stages. Between x = 8 and x = 16 nothing but slabs stands for long.
_BOXES = [
    (((0, 0, -0.2), (24, 9, 0)), (1, 2)),
    (((0, 0, 2.8), (24, 9, 3.0)), (1, 2)),
    (((0, -0.2, 0), (24, 0, 2.8)), (1, 2)),
    (((-0.2, 0, 0), (0, 9, 2.8)), (1, 2)),
    (((4, 3, 0), (4.4, 3.4, 2.8)), (1, 2)),
    (((4, 6.5, 0), (7, 6.6, 2.8)), (1, 2)),
    (((18, 3, 0), (18.4, 3.4, 2.8)), (1, 2)),
    (((21, 5, 0), (21.1, 9, 2.8)), (1, 2)),
    (((2, 1, 0), (3.2, 2, 0.9)), (1,)),
    (((2.1, 1.15, 0), (3.3, 2.15, 0.9)), (2,)),  # the same stack, nudged
    (((9, 4, 0), (10, 5, 1.2)), (1,)),
    (((19, 1.5, 0), (20, 2.5, 1.4)), (1,)),
    (((19.1, 1.4, 0), (20.1, 2.4, 1.4)), (2,)),
    (((14, 2, 0), (15, 3, 1.0)), (2,)),
]


def make_floor(path, seed=0, spots=14):
    """Write the dataset; spots lie along the floor's length in each stage."""
    rng = np.random.default_rng(seed)
    writer = DatasetWriter(path, Manifest(seed=seed, simulation={}, labels=False))
    record = SiteRecord(
        area="1", stages=2, stage_names=[], extent=(0, 0, *SIZE), floor_height=0, elements=[]
    )
    writer.begin_area(record, {})
    for stage in (1, 2):
        faces = [_faces(rng, *np.array(box, float)) for box, stages in _BOXES if stage in stages]
        points, normals = (np.concatenate(part) for part in zip(*faces, strict=True))
        for spot in range(1, spots + 1):
            along = 1.0 + (SIZE[0] - 2) * (spot - 1) / (spots - 1)
            position = (along, rng.uniform(1.5, SIZE[1] - 1.5), 1.6)
            pose = from_yaw(rng.uniform(-np.pi, np.pi), position)
            near = np.linalg.norm(points - position, axis=1) < RANGE
            seen = points[near] + rng.normal(0, 0.004, (near.sum(), 3))
            columns = FragmentColumns(
                transform_points(inverse(pose), seen).astype(np.float32),
                (normals[near] @ pose[:3, :3]).astype(np.float32),
            )
            writer.append(FragmentId("1", stage, spot), pose, columns)
    writer.finish_area("1")
    writer.finish()


def _faces(rng, low, high):
    """Points and outward normals of a box."""
    points, normals = [], []
    for axis in range(3):
        others = [i for i in range(3) if i != axis]
        count = int(np.prod((high - low)[others]) * 60)
        for value, sign in ((low[axis], -1), (high[axis], 1)):
            face = rng.uniform(low, high, (count, 3))
            face[:, axis] = value
            points.append(face)
            normals.append(np.tile(sign * np.eye(3)[axis], (count, 1)))
    return np.concatenate(points), np.concatenate(normals)
