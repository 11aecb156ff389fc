"""The synchronizer `submaps`: what is ambiguous between two fragments, submaps decide.

The relative transforms of pairs, each ambiguous on its own, are judged by submaps: these are
joined, their fragments settle where they fit best, of each pair the hypothesis that fits stays, and
relative transforms are found that no pair gave. The line process of `choi` then has the last word.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch

from nss_ros.config import GravityConfig, MultiwayConfig, RegistrationConfig
from nss_ros.fragment import Fragment, FragmentId
from nss_ros.geometry import relative
from nss_ros.multiway.choi import Choi
from nss_ros.multiway.closures import SUBMAP_CONFIDENCE, closures, decided
from nss_ros.multiway.hypotheses import fitting_hypothesis
from nss_ros.multiway.judged_edge import canonical
from nss_ros.multiway.known import known_by
from nss_ros.multiway.pose_graph import Measurement, PoseGraph
from nss_ros.multiway.settling import settled
from nss_ros.multiway.spanning_tree import Closeness, Poses
from nss_ros.multiway.standpoints import between_standpoints, graph_of_fragments
from nss_ros.multiway.submap_fragment import SubmapFragment, submap_fragment
from nss_ros.multiway.submap_joining import joined_submaps
from nss_ros.registration.gravity.weights import load_weights
from nss_ros.standpoint import is_origin

# A hypothesis fits a submap when it is this near, metres and radians; of two that are, at the next
# stud for example, the farther one would pull.
_FITTING = Closeness(0.15, np.radians(2.5))


class Submaps:
    """Registration of submaps, then line-process optimisation.

    Args:
        config: settings.

    Raises:
        MethodError: the weights cannot be read.
    """

    name = "submaps"

    def __init__(self, config: MultiwayConfig) -> None:
        self._config = config
        self._registration = RegistrationConfig(
            gravity=GravityConfig(weights=config.submap_weights),
            find_standpoints=config.find_standpoints,
        )
        # The sums of one thread are always the same.
        torch.set_num_threads(1)
        self._network = load_weights(config.submap_weights).network
        self._choi = Choi(config)

    def prepare(self, fragment: Fragment) -> SubmapFragment | None:
        """A fragment as a part of submaps; None if it cannot be: see `submap_fragment`."""
        return submap_fragment(fragment, self._network, self._registration)

    def synchronize(
        self,
        fragments: Sequence[FragmentId],
        measurements: Sequence[Measurement],
        known: PoseGraph | None = None,
    ) -> PoseGraph:
        """Without points: the result of `choi`, which goes on from what is known."""
        if known is None:
            graph = self._choi.synchronize(fragments, measurements)
        else:
            kept = known_by(known, measurements, self._choi.close)
            graph = self._choi.synchronize(
                fragments, kept.measurements, rejected=kept.rejected, parts=kept.parts
            )
            graph = _doubted(graph, known.doubtful())
        return replace(graph, synchronizer=self.name)

    def synchronize_points(
        self,
        fragments: Sequence[FragmentId],
        measurements: Sequence[Measurement],
        prepared: Mapping[FragmentId, SubmapFragment],
    ) -> PoseGraph:
        """Poses of all fragments; see `PointSynchronizer.synchronize_points`.

        Measurements of fragments that cannot be part of a submap are passed on to `choi` as they
        are.
        """
        places = {
            id_: each.standpoint for id_, each in prepared.items() if not is_origin(each.standpoint)
        }
        measurements = [between_standpoints(m, places) for m in sorted(measurements, key=canonical)]
        ids = [id_ for id_ in sorted(set(fragments)) if id_ in prepared]
        prepared = {id_: prepared[id_] for id_ in ids}
        inside = [m for m in measurements if _both(m, prepared)]
        outside = [m for m in measurements if not _both(m, prepared)]
        joined = joined_submaps(ids, inside, prepared, self._choi)
        held = {end for m in inside if m.manual for end in (m.pair.source, m.pair.target)}
        parts = [settled(part, prepared, held) for part in joined.parts]
        fitting, rejected = _judged(inside, parts)
        kept = decided(fitting, prepared, self._registration)
        found = [
            each
            for part in parts
            for each in closures(part, _within(kept, part), prepared, self._registration)
        ]
        # What cannot be part of a submap is linked by measurements from outside only.
        start = {id_: np.eye(4) for id_ in fragments}
        start |= {id_: pose for part in parts for id_, pose in part.items()}
        graph = self._choi.synchronize(
            fragments,
            [*outside, *kept, *found],
            None if outside else start,
            rejected,
        )
        graph = _doubted(graph_of_fragments(graph, places), joined.doubtful)
        return replace(graph, synchronizer=self.name)


def _doubted(graph: PoseGraph, doubtful: Collection[FragmentId]) -> PoseGraph:
    """The graph, whose nodes tell that their places are doubtful."""
    nodes = tuple(replace(node, doubtful=node.id in doubtful) for node in graph.nodes)
    return replace(graph, nodes=nodes)


def _both(m: Measurement, prepared: Mapping[FragmentId, SubmapFragment]) -> bool:
    return m.pair.source in prepared and m.pair.target in prepared


def _within(measurements: Sequence[Measurement], part: Poses) -> list[Measurement]:
    return [m for m in measurements if m.pair.source in part and m.pair.target in part]


def _judged(
    measurements: Sequence[Measurement], parts: Sequence[Poses]
) -> tuple[list[Measurement], list[tuple[Measurement, str]]]:
    """Those that fit the submaps, by their fitting hypothesis, and those that do not."""
    part_of = {id_: part for part in parts for id_ in part}
    kept: list[Measurement] = []
    rejected: list[tuple[Measurement, str]] = []
    for m in measurements:
        part = part_of[m.pair.source]
        if m.manual:
            kept.append(m)
        elif m.pair.target not in part:
            rejected.append((m, "too little speaks for joining the submaps that it links"))
        else:
            there = relative(part[m.pair.source], part[m.pair.target])
            fitting = fitting_hypothesis(m, there, _FITTING)
            if fitting is None:
                rejected.append((m, "none of its hypotheses agrees with the submaps"))
            else:
                sure = max(fitting.confidence, SUBMAP_CONFIDENCE)
                kept.append(replace(fitting, confidence=sure))
    return kept, rejected
