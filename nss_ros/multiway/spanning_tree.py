"""Initial poses by walking a spanning tree of the best measurements."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from heapq import heappop, heappush

import numpy as np
from numpy.typing import NDArray

from nss_ros.fragment import FragmentId
from nss_ros.geometry import Transform, inverse
from nss_ros.multiway.pose_graph import Edge, Measurement

Poses = dict[FragmentId, Transform]


def components(
    fragments: Sequence[FragmentId], measurements: Sequence[Measurement | Edge]
) -> list[list[FragmentId]]:
    """Connected components, largest first, ties and members in canonical order."""
    parent = {id_: id_ for id_ in fragments}

    def root(id_: FragmentId) -> FragmentId:
        while parent[id_] != id_:
            parent[id_] = parent[parent[id_]]
            id_ = parent[id_]
        return id_

    for edge in measurements:
        one, other = sorted((root(edge.pair.source), root(edge.pair.target)))
        parent[other] = one
    groups: dict[FragmentId, list[FragmentId]] = {}
    for id_ in sorted(fragments):
        groups.setdefault(root(id_), []).append(id_)
    return sorted(groups.values(), key=lambda group: (-len(group), group[0]))


def spanning_tree_poses(
    members: Sequence[FragmentId],
    measurements: Sequence[Measurement],
    ranks: NDArray[np.float64],
    votes: Closeness | None = None,
) -> Poses:
    """Poses `T_anchor_fragment` of one component, the first member being the anchor.

    The tree is grown in one piece from the best measurement (Prim), so that wrong measurements
    stay at its leaves. With `votes`, the next fragment is the one on whose pose most measurements
    from the fragments placed so far agree: loops of any length then count, not triangles only.

    Args:
        members: of the component.
        measurements: that link them, all within the component.
        ranks: (n, k) per measurement; larger is better, the first column counts first.
        votes: how close two poses of a fragment must be to agree; None: do not count votes.
    """
    growth = _Growth(measurements, ranks, votes)
    order = sorted(range(len(measurements)), key=growth.rank)
    growth.place(measurements[order[0]].pair.target, np.eye(4))
    while len(growth.poses) < len(members):
        growth.place(*growth.next())
    return anchored(growth.poses, members[0])


@dataclass(frozen=True, slots=True)
class Closeness:
    """When two transforms agree: within this distance (m) and angle (rad)."""

    translation: float
    rotation: float

    def agree(self, one: Transform, others: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Which of the others (n, 4, 4) agree with one, (n,)."""
        near = np.linalg.norm(others[:, :3, 3] - one[:3, 3], axis=1) < self.translation
        cosine = (np.einsum("nij,ij->n", others[:, :3, :3], one[:3, :3]) - 1) / 2
        return np.asarray(near & (cosine > np.cos(self.rotation)))


class _Growth:
    """A tree being grown: placed fragments, and predicted poses of their neighbours."""

    def __init__(
        self,
        measurements: Sequence[Measurement],
        ranks: NDArray[np.float64],
        votes: Closeness | None,
    ) -> None:
        self.poses: Poses = {}
        self._measurements = measurements
        self._ranks = ranks
        self._votes = votes
        self._touching: dict[FragmentId, list[int]] = {}
        for i, edge in enumerate(measurements):
            self._touching.setdefault(edge.pair.source, []).append(i)
            self._touching.setdefault(edge.pair.target, []).append(i)
        self._predictions: dict[FragmentId, list[tuple[int, Transform]]] = {}
        self._counts: dict[FragmentId, list[int]] = {}
        self._best: list[tuple[tuple[object, ...], FragmentId, int]] = []

    def rank(self, i: int, votes: int = 0) -> tuple[object, ...]:
        """Sorting key of a measurement, best first."""
        first, *others = (-self._ranks[i]).tolist()
        return (first, -votes, *others, self._measurements[i].pair, i)

    def place(self, new: FragmentId, pose: Transform) -> None:
        """Add a fragment to the tree, and predict its neighbours from it."""
        self.poses[new] = pose
        self._predictions.pop(new, None)
        for i in self._touching.get(new, []):
            edge = self._measurements[i]
            other = edge.pair.source if edge.pair.target == new else edge.pair.target
            if other in self.poses:
                continue
            step = edge.T_target_source
            step = step if other == edge.pair.source else inverse(step)
            self._predict(other, i, pose @ step)

    def next(self) -> tuple[FragmentId, Transform]:
        """The fragment to place next, with its pose."""
        while True:
            _, id_, i = heappop(self._best)
            if id_ not in self.poses:
                return id_, next(pose for j, pose in self._predictions[id_] if j == i)

    def _predict(self, id_: FragmentId, i: int, pose: Transform) -> None:
        predictions = self._predictions.setdefault(id_, [])
        predictions.append((i, pose))
        if self._votes is None:
            heappush(self._best, (self.rank(i), id_, i))
            return
        stack = np.array([p for _, p in predictions])
        agreeing = np.flatnonzero(self._votes.agree(pose, stack))
        counts = self._counts.setdefault(id_, [])
        counts.append(len(agreeing))
        for j in agreeing:
            counts[j] += int(j < len(predictions) - 1)
            other, _ = predictions[j]
            heappush(self._best, (self.rank(other, counts[j]), id_, other))


def anchored(poses: Poses, anchor: FragmentId) -> Poses:
    """The same poses in the frame of one fragment."""
    to_anchor = inverse(poses[anchor])
    return {id_: to_anchor @ pose for id_, pose in poses.items()}
