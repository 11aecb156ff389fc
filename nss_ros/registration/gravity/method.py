"""The method `gravity`: exhaustive search, robust ICP and a calibrated choice.

Levelled fragments differ by yaw and translation only. All yaw angles and shifts in x and y are
scored at once on learned maps (`search`), the best hypotheses are aligned (`refinement`), and
each gets the probability that it is right (`verifier`). Fragments that reach much farther than a
Matterport have wider maps and a search of their own (`wide`). Those that are not levelled are left
to `fpfh_ransac`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nss_ros.config import RegistrationConfig
from nss_ros.fragment import Fragment, FragmentId, FragmentPair
from nss_ros.geometry import (
    Matrix,
    Transform,
    from_yaw,
    inverse,
    logarithm,
    relative,
    rotation_angle,
)
from nss_ros.registration.features import FpfhFeatures
from nss_ros.registration.fpfh import FpfhRansac
from nss_ros.registration.gravity.comparison import compared
from nss_ros.registration.gravity.correlation import planar, score_parts, turned_spectra
from nss_ros.registration.gravity.network import GravityNetwork, as_target
from nss_ros.registration.gravity.polish import polished
from nss_ros.registration.gravity.raster import Raster
from nss_ros.registration.gravity.refinement import Alignment, Candidate, Shape, aligned, judged
from nss_ros.registration.gravity.scan import LevelScan, is_wide_scan, scan_of, wide_scan_of
from nss_ros.registration.gravity.search import Search, search
from nss_ros.registration.gravity.verifier import Judgement, judge
from nss_ros.registration.gravity.weights import Networks, load_weights
from nss_ros.registration.gravity.wide import (
    empty_weight,
    evened,
    is_wide,
    weighed,
    wide_search,
)
from nss_ros.registration.relative_transform import (
    Hypothesis,
    Reason,
    RelativeTransform,
    failed,
)
from nss_ros.registration.validation import support

# Alignments closer than this are one hypothesis.
_SAME_TRANSLATION, _SAME_ROTATION = 0.1, np.radians(3)
_LEAST_PROBABILITY = 0.01
# Hypotheses within this of the best one are taken for the same place, uncertainly known.
_SPREAD_TRANSLATION, _SPREAD_ROTATION = 1.0, np.radians(6)
# Poses this much less likely than the best one, by the logarithm, are hardly ever right.
_MOST_MARGIN = 7.0
# Within a stage, a best hypothesis that is less probable is not taken before a tolerant search.
_SURE = 0.8
# Hypotheses with a probability between these are moved nearby: the others are hardly ever right, or
# hardly ever wrong.
_LIKELY, _CERTAIN = 0.1, 0.95


@dataclass(frozen=True, slots=True)
class GravityFeatures:
    """What the method keeps of a fragment.

    Attributes:
        id: the fragment.
        points: voxelised points that it has.
        shape: what alignment needs; None when it is not levelled or has too few points.
        maps: (2, CHANNELS, h, w) float32, as a source: for a pair of different stages, and for
            one of one stage; None when `shape` is.
        generic: features for `fpfh_ransac` when it is not levelled, else None.
        near: of a fragment with wide maps, the same with maps of the usual size; None without
            wide maps, or where too few points are near.
    """

    id: FragmentId
    points: int
    shape: Shape | None
    maps: NDArray[np.float32] | None
    generic: FpfhFeatures | None
    near: GravityFeatures | None = None


class _Turned(NamedTuple):
    """Features of a fragment, the number of those for a kind of pair, and their spectra."""

    maps: NDArray[np.float32]
    kind: int
    spectra: tuple[Tensor, ...]

    def is_of(self, maps: NDArray[np.float32], kind: int) -> bool:
        """They are of these very features; which are held, so that no others are in their place."""
        return self.maps is maps and self.kind == kind


class Gravity:
    """Exhaustive registration of levelled fragments."""

    name = "gravity"

    def __init__(self, config: RegistrationConfig, networks: Networks | None = None) -> None:
        # There are as many workers as cores, and the sums of one thread are always the same.
        torch.set_num_threads(1)
        self.config = config
        self._generic = FpfhRansac(config)
        self._networks = networks or load_weights(config.gravity.weights)
        self._turned: _Turned | None = None

    def prepare(self, fragment: Fragment) -> GravityFeatures:
        """Points, maps and features of a fragment."""
        if not fragment.gravity_aligned:
            generic = self._generic.prepare(fragment)
            return GravityFeatures(fragment.id, len(generic.points), None, None, generic)
        usual = self.prepare_scan(scan_of(fragment, self.config))
        if not is_wide_scan(fragment):
            return usual
        wide = self.prepare_scan(wide_scan_of(fragment, self.config))
        # On open ground nearly all may be beyond the usual maps.
        return wide if usual.shape is None else replace(wide, near=usual)

    def prepare_scan(self, scan: LevelScan) -> GravityFeatures:
        """Features of a levelled fragment."""
        count = len(scan.points)
        if count < self.config.min_points:
            return GravityFeatures(scan.id, count, None, None, None)
        shape = Shape.of(scan, self.config)
        return GravityFeatures(
            scan.id, count, shape, feature_maps(self._networks.network, scan.maps), None
        )

    def register(
        self, source: GravityFeatures, target: GravityFeatures, seed: int
    ) -> RelativeTransform:
        """`T_target_source` of two prepared fragments; the seed is for those not levelled."""
        if source.generic is not None and target.generic is not None:
            answer = self._generic.register(source.generic, target.generic, seed)
            return replace(answer, method=self.name)
        pair = FragmentPair(source.id, target.id)
        for features in (source, target):
            if features.points < self.config.min_points:
                message = (
                    f"{features.id} has {features.points} voxelised points, fewer than "
                    f"{self.config.min_points}."
                )
                return failed(pair, self.name, Reason.TOO_FEW_POINTS, message)
            if features.shape is None:
                message = (
                    f"{features.id} is not levelled and the other fragment is: level both, or "
                    "neither."
                )
                return failed(pair, self.name, Reason.NOT_LEVEL, message)
        return self._answer(pair, source, target)

    def candidates(self, source: GravityFeatures, target: GravityFeatures) -> tuple[Candidate, ...]:
        """Aligned hypotheses of two levelled fragments, in the order of the search."""
        found = self.search(source, target, self.config.gravity.hypotheses)
        return self._candidates(source, target, found, self._alignments(source, target, found))

    def _alignments(
        self, source: GravityFeatures, target: GravityFeatures, found: Search
    ) -> list[Alignment]:
        """The promising poses of a search, aligned; those that end in one place are one."""
        assert source.shape is not None
        assert target.shape is not None
        alignments: list[Alignment] = []
        for peak in found.peaks:
            if peak.score < found.peaks[0].score - _MOST_MARGIN:
                break
            alignment = aligned(source.shape, target.shape, peak, self.config)
            if not _is_known(alignment.refined.T_target_source, alignments):
                alignments.append(alignment)
        return alignments

    def _candidates(
        self,
        source: GravityFeatures,
        target: GravityFeatures,
        found: Search,
        alignments: Sequence[Alignment],
    ) -> tuple[Candidate, ...]:
        """Alignments with their signs."""
        assert source.shape is not None
        assert target.shape is not None
        maps = self._maps(source, target)
        poses = planar(np.stack([each.refined.T_target_source for each in alignments]))
        parts = score_parts(*maps, *poses).tolist()
        looks = self._second_looks(*maps, *poses)
        shapes = source.shape, target.shape
        weight = empty_weight(_same_stage(source, target)) if is_wide(*maps) else 0.0
        return tuple(
            judged(*shapes, alignment, each, look, found, self.config, weight)
            for alignment, each, look in zip(alignments, parts, looks, strict=True)
        )

    def _tolerant_alignments(
        self, source: GravityFeatures, target: GravityFeatures, found: Search
    ) -> list[Alignment]:
        """Aligned poses that the features for different stages find in fragments of one stage.

        Within a stage they are not looked at first, since there hardly anything contradicts a right
        pose. What does, say a mirror, a person or a load on the scanner's carrier, they forgive.
        """
        moving, still = self._features(source, target, 0)
        with torch.inference_mode():
            spectra = turned_spectra(moving)
        peaks = search(spectra, still, self.config.gravity.hypotheses).peaks
        alignments = self._alignments(source, target, replace(found, peaks=peaks))
        poses = np.stack(
            [from_yaw(each.peak.yaw, (each.peak.x, each.peak.y, 0.0)) for each in alignments]
        )
        scores = score_parts(*self._maps(source, target), *planar(poses)).sum(dim=1).tolist()
        best = found.peaks[0]
        return [
            replace(each, peak=replace(each.peak, score=score, mass=best.mass + score - best.score))
            for each, score in zip(alignments, scores, strict=True)
        ]

    def _second_looks(
        self, source: Tensor, target: Tensor, yaws: Tensor, shifts: Tensor
    ) -> list[tuple[float, float]]:
        """Log-odds of poses, and these less the largest; 0 for wide maps, which it does not know.

        Args:
            source: (c, n, n), as a source.
            target: (c, m, m), as a target.
            yaws: (k,) radians.
            shifts: (k, 2), metres.
        """
        if is_wide(source, target):
            return [(0.0, 0.0)] * len(yaws)
        # `as_target` twice gives the features as a source again.
        odds = compared(self._networks.comparison, source, as_target(target), yaws, shifts).tolist()
        return [(each, each - max(odds)) for each in odds]

    def search(self, source: GravityFeatures, target: GravityFeatures, count: int) -> Search:
        """The `count` best poses before any refinement."""
        maps = self._maps(source, target)
        if not is_wide(*maps):
            return search(self._turned_spectra(source, target), maps[1], count)
        assert source.shape is not None
        assert target.shape is not None
        same_stage = _same_stage(source, target)
        return weighed(wide_search(*maps), source.shape, target.shape, same_stage, count)

    def _turned_spectra(
        self, source: GravityFeatures, target: GravityFeatures
    ) -> tuple[Tensor, ...]:
        """Spectra of the source; those of the last one are kept, for its next target."""
        maps, kind = source.maps, int(_same_stage(source, target))
        assert maps is not None
        if self._turned is None or not self._turned.is_of(maps, kind):
            self._turned = None  # two at once would be 172 MB
            with torch.inference_mode():
                spectra = turned_spectra(torch.from_numpy(maps[kind]))
            self._turned = _Turned(maps, kind, spectra)
        return self._turned.spectra

    def _maps(self, source: GravityFeatures, target: GravityFeatures) -> tuple[Tensor, Tensor]:
        """Features of the one as a source and of the other as a target."""
        moving, still = self._features(source, target, int(_same_stage(source, target)))
        if is_wide(moving, still):
            moving = evened(moving, still)
        return moving, still

    def _features(
        self, source: GravityFeatures, target: GravityFeatures, kind: int
    ) -> tuple[Tensor, Tensor]:
        """The same for a kind of pair, not evened."""
        assert source.maps is not None
        assert target.maps is not None
        moving, still = torch.from_numpy(source.maps[kind]), torch.from_numpy(target.maps[kind])
        return moving, as_target(still)

    def _answer(
        self, pair: FragmentPair, source: GravityFeatures, target: GravityFeatures
    ) -> RelativeTransform:
        """The answer by wide maps, if any is wide; by the usual ones, too, where it is not sure.

        Wide maps have coarser poses looked at first, and no second look.
        """
        answer = self._best_answer(pair, source, target)
        if answer.confidence >= _SURE or source.near is target.near is None:
            return answer
        near = self._best_answer(pair, source.near or source, target.near or target)
        return _surer(answer, near)

    def _best_answer(
        self, pair: FragmentPair, source: GravityFeatures, target: GravityFeatures
    ) -> RelativeTransform:
        found = self.search(source, target, self.config.gravity.hypotheses)
        alignments = self._alignments(source, target, found)
        candidates = self._candidates(source, target, found, alignments)
        judgement = self._judged(pair, candidates)
        usual = not is_wide(*self._features(source, target, 1))
        if pair.same_stage and usual and judgement.probabilities.max() < _SURE:
            for each in self._tolerant_alignments(source, target, found):
                if not _is_known(each.refined.T_target_source, alignments):
                    alignments.append(each)
            candidates = self._candidates(source, target, found, alignments)
            judgement = self._judged(pair, candidates)
        best, *others = self._polished(source, target, candidates, judgement)
        transforms = [each.T_target_source for each in (best, *others)]
        probabilities = np.array([each.probability for each in (best, *others)])
        assert source.shape is not None
        assert target.shape is not None
        there = support(source.shape.moderate, target.shape.surface, transforms[0], self.config)
        return RelativeTransform(
            pair,
            self.name,
            T_target_source=best.T_target_source,
            covariance=best.covariance + hypothesis_spread(transforms, probabilities, 0),
            overlap_probability=judgement.overlap,
            confidence=best.probability,
            inliers=there.inliers,
            inlier_ratio=there.inlier_ratio,
            rmse=there.rmse,
            alternatives=tuple(each for each in others if each.probability > _LEAST_PROBABILITY),
        )

    def _polished(
        self,
        source: GravityFeatures,
        target: GravityFeatures,
        candidates: Sequence[Candidate],
        judgement: Judgement,
    ) -> list[Hypothesis]:
        """The hypotheses, likeliest first; the likely ones that are not sure moved nearby.

        Those that end in one place are one, as probable as all of them.
        """
        assert source.shape is not None
        assert target.shape is not None
        maps = self._maps(source, target)

        def scores(transforms: NDArray[np.float64]) -> NDArray[np.float64]:
            return score_parts(*maps, *planar(transforms)).sum(dim=1).double().numpy()

        found: list[Hypothesis] = []
        for number in np.argsort(-judgement.probabilities, kind="stable"):
            refined = candidates[number].refined
            probability = float(judgement.probabilities[number])
            if _LIKELY < probability < _CERTAIN:
                refined = polished(source.shape, target.shape, refined, scores, self.config)
            for place, known in enumerate(found):
                if _is_same(refined.T_target_source, known.T_target_source):
                    found[place] = replace(known, probability=known.probability + probability)
                    break
            else:
                found.append(Hypothesis(refined.T_target_source, probability, refined.covariance))
        return sorted(found, key=lambda each: -each.probability)

    def _judged(self, pair: FragmentPair, candidates: Sequence[Candidate]) -> Judgement:
        signs = [each.signs for each in candidates]
        return judge(self._networks.verifier, signs, pair.same_stage)


def feature_maps(network: GravityNetwork, raster: Raster) -> NDArray[np.float32]:
    """Features (2, CHANNELS, h, w) as a source, for different stages and for one."""
    with torch.inference_mode():
        maps = torch.from_numpy(raster).float()[None]
        shared = network(maps)
        both = [network.features(maps, shared, bool(kind))[0] for kind in range(2)]
        return np.asarray(torch.stack(both).numpy())


def hypothesis_spread(
    transforms: Sequence[Transform], probabilities: NDArray[np.float64], best: int
) -> Matrix:
    """Covariance (6, 6) by the hypotheses beside the best one, order x y z rx ry rz.

    Along a corridor, poses that slide look about as good as the best one, and the Hessian of its
    alignment does not know of them. Hypotheses far away are other places, not an uncertainty.

    Args:
        transforms: each `T_target_source`.
        probabilities: of them.
        best: number of the one that the covariance is of.
    """
    back = inverse(transforms[best])
    twists = [logarithm(transform @ back) for transform in transforms]
    moves = [relative(transform, transforms[best]) for transform in transforms]
    near = np.array(
        [
            np.linalg.norm(move[:3, 3]) < _SPREAD_TRANSLATION
            and rotation_angle(move) < _SPREAD_ROTATION
            for move in moves
        ]
    )
    weights = np.where(near, probabilities, 0.0)
    weights = weights / max(float(weights.sum()), 1e-12)
    stack = np.array(twists)
    return np.asarray(np.einsum("k,ki,kj->ij", weights, stack, stack))


def _surer(one: RelativeTransform, other: RelativeTransform) -> RelativeTransform:
    """The answer of the higher confidence; what the other one says has the probability it leaves.

    Args:
        one: answer to a pair.
        other: answer to the same pair.
    """
    better, worse = (one, other) if one.confidence >= other.confidence else (other, one)
    hypotheses = [_first_hypothesis(better), *better.alternatives]
    left = max(1.0 - sum(each.probability for each in hypotheses), 0.0)
    for each in (_first_hypothesis(worse), *worse.alternatives):
        probability = left * each.probability
        known = any(_is_same(each.T_target_source, h.T_target_source) for h in hypotheses)
        if probability > _LEAST_PROBABILITY and not known:
            hypotheses.append(replace(each, probability=probability))
    alternatives = sorted(hypotheses[1:], key=lambda each: -each.probability)
    return replace(better, alternatives=tuple(alternatives))


def _first_hypothesis(answer: RelativeTransform) -> Hypothesis:
    return Hypothesis(answer.T_target_source, answer.confidence, answer.covariance)


def _same_stage(source: GravityFeatures, target: GravityFeatures) -> bool:
    return FragmentPair(source.id, target.id).same_stage


def _is_known(transform: Transform, alignments: Sequence[Alignment]) -> bool:
    return any(_is_same(transform, each.refined.T_target_source) for each in alignments)


def _is_same(one: Transform, other: Transform) -> bool:
    difference = relative(one, other)
    return bool(
        np.linalg.norm(difference[:3, 3]) < _SAME_TRANSLATION
        and rotation_angle(difference) < _SAME_ROTATION
    )
