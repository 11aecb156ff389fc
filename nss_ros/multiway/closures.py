"""What a submap tells of pairs: transforms that nobody asked for, and how sure the others are."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from nss_ros.config import RegistrationConfig
from nss_ros.fragment import FragmentId, FragmentPair
from nss_ros.geometry import Transform, relative
from nss_ros.icp import Refined, Surface, moved_by
from nss_ros.multiway.measurement import information
from nss_ros.multiway.pose_graph import Measurement
from nss_ros.multiway.spanning_tree import Poses, components
from nss_ros.multiway.submap_fragment import Fragments, farthest
from nss_ros.registration.gravity.refinement import COARSE_POINTS, refined_near

_LEAST_OVERLAP = 0.2
_OVERLAP_POINTS = 300
# A fragment with this many edges needs no more.
_ENOUGH = 6
# How likely what a submap says is right; all that it accepts is at least as likely.
SUBMAP_CONFIDENCE = 0.9


def closures(
    part: Poses,
    accepted: Sequence[Measurement],
    fragments: Fragments,
    config: RegistrationConfig,
) -> list[Measurement]:
    """Measurements that link the fragments of a submap with those that they overlap.

    Those with few edges get more, and so do those that none links with the rest.

    Args:
        part: poses of the fragments.
        accepted: what links them already.
        fragments: prepared.
        config: of the alignment.
    """
    surfaces = _Surfaces(fragments, config)
    known = {frozenset(_ends(m.pair)) for m in accepted}
    degrees = dict.fromkeys(part, 0)
    for m in accepted:
        for end in _ends(m.pair):
            degrees[end] += 1
    found: list[Measurement] = []
    left: list[tuple[float, FragmentPair]] = []
    for share, pair in _overlapping(part, known, fragments, surfaces):
        wanted = min(degrees[end] for end in _ends(pair)) < _ENOUGH
        if share < _LEAST_OVERLAP or not wanted:
            left.append((share, pair))
            continue
        found.append(surfaces.measured(pair, part))
        for end in _ends(pair):
            degrees[end] += 1
    return found + _links(part, [*accepted, *found], [pair for _, pair in left], surfaces)


def decided(
    measurements: Iterable[Measurement], fragments: Fragments, config: RegistrationConfig
) -> list[Measurement]:
    """Measurements that a submap says are right, with the information of their alignment alone.

    The covariance of a pair also holds what its other hypotheses say, along a corridor metres. Once
    it is decided which one is right, that lets poses slide where turns do not quite agree.

    Args:
        measurements: that fit the submap; those by people stay as they are.
        fragments: prepared.
        config: of the alignment.
    """
    surfaces = _Surfaces(fragments, config)
    return [
        m
        if m.manual
        else replace(
            m, information=information(surfaces.aligned(m.pair, m.T_target_source).covariance)
        )
        for m in measurements
    ]


def _links(
    part: Poses,
    measurements: list[Measurement],
    pairs: Iterable[FragmentPair],
    surfaces: _Surfaces,
) -> list[Measurement]:
    """Measurements of the first pairs that link what nothing links."""
    number = {
        id_: n for n, group in enumerate(components(sorted(part), measurements)) for id_ in group
    }
    added = []
    for pair in pairs:
        one, other = (number[end] for end in _ends(pair))
        if one != other:
            added.append(surfaces.measured(pair, part))
            number = {id_: one if n == other else n for id_, n in number.items()}
    return added


def _ends(pair: FragmentPair) -> tuple[FragmentId, FragmentId]:
    return pair.source, pair.target


def _overlapping(
    part: Poses, known: set[frozenset[FragmentId]], fragments: Fragments, surfaces: _Surfaces
) -> list[tuple[float, FragmentPair]]:
    """Share of the points that lie on the other fragment, and the pair; most first."""
    found = []
    for source, target in combinations(sorted(part), 2):
        distance = np.linalg.norm(part[source][:2, 3] - part[target][:2, 3])
        most = farthest(fragments[source], fragments[target])
        if distance > most or frozenset((source, target)) in known:
            continue
        pair = FragmentPair(source, target)
        if (share := surfaces.overlap(pair, relative(part[source], part[target]))) > 0:
            found.append((share, pair))
    return sorted(found, key=lambda each: (-each[0], each[1]))


class _Surfaces:
    """Surfaces of fragments, made when they are wanted."""

    def __init__(self, fragments: Fragments, config: RegistrationConfig) -> None:
        self._fragments, self._config = fragments, config
        self._whole: dict[FragmentId, Surface] = {}

    def overlap(self, pair: FragmentPair, T_target_source: Transform) -> float:
        """Share of the source's points that lie on the target."""
        points = self._fragments[pair.source].points
        some = points[:: max(len(points) // _OVERLAP_POINTS, 1)].astype(np.float64)
        distances, _ = self._surface(pair.target).tree.query(
            moved_by(T_target_source, some), distance_upper_bound=self._config.overlap_distance
        )
        return float(np.isfinite(distances).mean())

    def measured(self, pair: FragmentPair, part: Poses) -> Measurement:
        """The alignment of a pair near the poses of its submap."""
        refined = self.aligned(pair, relative(part[pair.source], part[pair.target]))
        return Measurement(
            pair,
            refined.T_target_source,
            information(refined.covariance),
            confidence=SUBMAP_CONFIDENCE,
            inliers=refined.correspondences,
            level=True,
            submap=True,
        )

    def aligned(self, pair: FragmentPair, T_target_source: Transform) -> Refined:
        """The alignment of a pair near a transform."""
        return refined_near(
            self._sample(pair.source, COARSE_POINTS),
            self._sample(pair.source, self._config.icp.max_points),
            self._surface(pair.target),
            T_target_source,
            self._config,
        )

    def _surface(self, id_: FragmentId) -> Surface:
        if id_ not in self._whole:
            fragment = self._fragments[id_]
            self._whole[id_] = Surface.of(fragment.points, fragment.normals)
        return self._whole[id_]

    def _sample(self, id_: FragmentId, count: int) -> Surface:
        return Surface.sample(self._fragments[id_].points, self._fragments[id_].normals, count)
