"""Local refinement of ground truth between stages (NSS paper, ground truth).

Scans of whole stages are aligned globally, but each has drifted in its own way, so the alignment
is not exact everywhere. For a pair of spots of different stages, upright cylinders around both
spots are cut from both stage scans and aligned by ICP from the global alignment. Small cylinders
hold too little that stands still and is unambiguous, large ones drift within themselves; the
paper takes 12 m from a plot over radii of 2 to 18 m, which `radius_study` makes.

Things that changed between the stages do not pull: ICP is point-to-plane with a kernel, normals
must agree, and correspondences are short. A result that is not well determined, or implausibly
large, leaves the global alignment as it is.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nss_ros.config import RefinementConfig
from nss_ros.dataset.folder import DatasetFolder
from nss_ros.dataset.stage_scan import StageScan, dataset_scan
from nss_ros.errors import FormatError, InputError
from nss_ros.files import write_file
from nss_ros.fragment import FragmentId, FragmentPair
from nss_ros.geometry import Transform, inverse, is_transform, relative, rotation_angle
from nss_ros.icp import Refined, moved_by, refine
from nss_ros.parallel import Engine, run

REFINED_NAME = "refined_pairs.jsonl"
STUDY_RADII = tuple(float(radius) for radius in range(2, 20, 2))

# Two stages of an area are in use at a time, and the next ones of the next pairs.
_SCANS_KEPT = 4


@dataclass(frozen=True, slots=True)
class RefinedPair:
    """Ground truth of one pair after refinement.

    Attributes:
        T_target_source: refined, or of the global alignment where `reason` says why not.
        reason: why the refinement was not taken; empty if it was.
        translation: correction at the middle between the spots, metres.
        rotation: correction, radians.
        rmse: point-to-plane distance of the correspondences, metres; NaN where it is not known.
        correspondences: of the last iteration.
        deviation: largest standard deviation of the correction along any direction, metres.
    """

    T_target_source: Transform
    reason: str
    translation: float
    rotation: float
    rmse: float
    correspondences: int
    deviation: float

    @property
    def accepted(self) -> bool:
        """Whether the refinement was taken."""
        return not self.reason


@dataclass(frozen=True, slots=True)
class RadiusStatistics:
    """How pairs refine with cylinders of one radius; medians over the pairs.

    Attributes:
        radius: metres.
        pairs: number of pairs.
        accepted: share of them whose refinement would be taken.
        rmse: point-to-plane distance of the correspondences, metres.
        correspondences: number of them.
        translation: correction at the middle between the spots, metres.
        rotation: correction, radians.
        spread: how far repeated subsamples lie from their mean at the spots, root mean square,
            metres.
        step: change of the spots' alignment since the radius before, metres; NaN for the first.
        error: distance from the true alignment at the spots, root mean square over the pairs,
            metres; NaN where the truth is not known.
    """

    radius: float
    pairs: int
    accepted: float
    rmse: float
    correspondences: float
    translation: float
    rotation: float
    spread: float
    step: float
    error: float


def refine_pair(
    source: StageScan,
    target: StageScan,
    T_map_source: Transform,
    T_map_target: Transform,
    config: RefinementConfig,
    seed: int = 0,
) -> RefinedPair:
    """Refine the relative transform of two spots of different stages.

    Args:
        source: scan of the source's stage, map frame.
        target: scan of the target's stage, map frame.
        T_map_source: pose of the source spot by the global alignment.
        T_map_target: pose of the target spot by the global alignment.
        config: radius, ICP and limits.
        seed: of the subsample of the source's points.
    """
    return _refine_cut(_cut(source, target, T_map_source, T_map_target, config, seed))


def refine_pairs(
    dataset: DatasetFolder,
    pairs: Sequence[FragmentPair],
    config: RefinementConfig,
    poses: Mapping[FragmentId, Transform] | None = None,
    workers: int = 0,
    engine: Engine = Engine.LOCAL,
    report: Callable[[FragmentPair], None] | None = None,
) -> dict[FragmentPair, RefinedPair]:
    """Refine pairs of different stages of a dataset.

    Args:
        dataset: whose fragments make up the stage scans.
        pairs: of different stages of one area.
        config: radius, ICP and limits.
        poses: global alignment `T_map_fragment`; None: the dataset's.
        workers: processes; 0: one per core.
        engine: local processes or Ray.
        report: called after each pair.

    Raises:
        InputError: a pair is not of two stages of one area, or a fragment is not known.
        FormatError: a fragment is missing or damaged.
    """
    known = dataset.poses() if poses is None else dict(poses)
    ordered = sorted(pairs, key=_by_stages)
    cuts = _cuts(dataset, ordered, [config], known, seeds=(0,))
    results: dict[FragmentPair, RefinedPair] = {}
    for pair, refined in zip(ordered, run(_refine_cut, cuts, workers, engine), strict=True):
        results[pair] = refined
        if report:
            report(pair)
    return {pair: results[pair] for pair in pairs}


def radius_study(
    dataset: DatasetFolder,
    pairs: Sequence[FragmentPair],
    config: RefinementConfig,
    radii: Sequence[float] = STUDY_RADII,
    repeats: int = 3,
    poses: Mapping[FragmentId, Transform] | None = None,
    truth: Mapping[FragmentId, Transform] | None = None,
    workers: int = 0,
    engine: Engine = Engine.LOCAL,
    report: Callable[[FragmentPair], None] | None = None,
) -> list[RadiusStatistics]:
    """Refine pairs with cylinders of several radii: the data of the paper's plot.

    What the limits of `config` would refuse is counted as it is.

    Args:
        dataset: whose fragments make up the stage scans.
        pairs: of different stages of one area.
        config: ICP and limits; its radius is not used.
        radii: metres, ascending.
        repeats: subsamples of the source's points per pair and radius.
        poses: global alignment `T_map_fragment`; None: the dataset's.
        truth: true poses, for datasets whose `poses` were made to drift.
        workers: processes; 0: one per core.
        engine: local processes or Ray.
        report: called after each pair.

    Returns:
        One row per radius.

    Raises:
        InputError: there is no pair, a pair is not of two stages of one area, or a fragment is
            not known.
        FormatError: a fragment is missing or damaged.
    """
    if not pairs:
        raise InputError("A study of radii needs pairs of different stages; there is none.")
    known = dataset.poses() if poses is None else dict(poses)
    ordered = sorted(pairs, key=_by_stages)
    configs = [config.model_copy(update={"radius": radius}) for radius in radii]
    cuts = _cuts(dataset, ordered, configs, known, seeds=range(repeats))
    results = run(_align_cut, cuts, workers, engine)
    trials = []
    for pair in ordered:
        trials.append([[next(results) for _ in range(repeats)] for _ in radii])
        if report:
            report(pair)
    ends = [_true_alignment(pair, known, truth) for pair in ordered]
    return [_statistics(radius, i, trials, ends) for i, radius in enumerate(radii)]


def write_refined(folder: Path, refined: Mapping[FragmentPair, RefinedPair]) -> None:
    """Write refined pairs into a dataset folder: one JSON object per line.

    Raises:
        FormatError: the file cannot be written.
    """
    lines = []
    for pair in sorted(refined):
        result = refined[pair]
        fields = {
            "source": str(pair.source),
            "target": str(pair.target),
            "T_target_source": result.T_target_source.tolist(),
            "reason": result.reason,
            "translation": result.translation,
            "rotation": result.rotation,
            "rmse": result.rmse if np.isfinite(result.rmse) else None,
            "correspondences": result.correspondences,
            "deviation": result.deviation if np.isfinite(result.deviation) else None,
        }
        lines.append(json.dumps(fields) + "\n")
    write_file(folder / REFINED_NAME, "".join(lines).encode())


def refined_transforms(folder: Path) -> dict[FragmentPair, Transform]:
    """`T_target_source` of the pairs that were refined, in both directions; none if none was.

    It is the ground truth of a pair where there is one; elsewhere it follows from the poses.

    Raises:
        FormatError: the file cannot be read or is not valid.
    """
    taken = {
        pair: each.T_target_source for pair, each in read_refined(folder).items() if each.accepted
    }
    turned = {FragmentPair(pair.target, pair.source): inverse(T) for pair, T in taken.items()}
    return turned | taken


def read_refined(folder: Path) -> dict[FragmentPair, RefinedPair]:
    """The refined pairs of a dataset folder; none if it has not been refined.

    Raises:
        FormatError: the file cannot be read or is not valid.
    """
    path = folder / REFINED_NAME
    if not path.exists():
        return {}
    try:
        lines = path.read_text().splitlines()
        return dict(_refined_line(json.loads(line)) for line in lines)
    except (OSError, ValueError, TypeError, KeyError, InputError) as error:
        raise FormatError(
            f"{path} does not hold refined pairs: remove it, or make it again with 'nss refine'."
        ) from error


def _refined_line(data: dict[str, object]) -> tuple[FragmentPair, RefinedPair]:
    pair = FragmentPair(
        FragmentId.parse(str(data.pop("source"))), FragmentId.parse(str(data.pop("target")))
    )
    matrix = np.array(data.pop("T_target_source"), dtype=np.float64)
    if not is_transform(matrix):
        raise InputError(f"The transform of {pair} is not rigid.")
    if data["deviation"] is None:
        data["deviation"] = np.inf
    if data["rmse"] is None:
        data["rmse"] = np.nan
    return pair, RefinedPair(T_target_source=matrix, **data)  # type: ignore[arg-type]


@dataclass(frozen=True, slots=True)
class _Cut:
    """What one alignment needs: small enough to be sent to another process."""

    source: StageScan
    target: StageScan
    T_map_source: Transform
    T_map_target: Transform
    config: RefinementConfig

    @property
    def middle(self) -> NDArray[np.float64]:
        """Between the spots, (3,) metres, map frame."""
        return np.asarray((self.T_map_source[:3, 3] + self.T_map_target[:3, 3]) / 2)


@dataclass(frozen=True, slots=True)
class _Aligned:
    """Raw outcome of one alignment.

    Attributes:
        correction: (4, 4) map frame, about the origin `middle`.
        result: as judged.
    """

    correction: Transform
    result: RefinedPair


def _cut(
    source: StageScan,
    target: StageScan,
    T_map_source: Transform,
    T_map_target: Transform,
    config: RefinementConfig,
    seed: int,
) -> _Cut:
    spots = np.array([T_map_source[:2, 3], T_map_target[:2, 3]])
    rng = np.random.default_rng(seed)
    return _Cut(
        source.near(spots, config.radius).sample(config.max_points, rng),
        target.near(spots, config.radius),
        T_map_source,
        T_map_target,
        config,
    )


def _cuts(
    dataset: DatasetFolder,
    pairs: Sequence[FragmentPair],
    configs: Sequence[RefinementConfig],
    poses: dict[FragmentId, Transform],
    seeds: Sequence[int],
) -> Iterator[_Cut]:
    for pair in pairs:
        _check_pair(pair, poses)

    @lru_cache(maxsize=_SCANS_KEPT)
    def scan(area: str, stage: int) -> StageScan:
        return dataset_scan(dataset, area, stage, configs[0].voxel_size, poses)

    def each() -> Iterator[_Cut]:
        for pair in pairs:
            source = scan(pair.source.area, pair.source.stage)
            target = scan(pair.target.area, pair.target.stage)
            for config in configs:
                for seed in seeds:
                    yield _cut(source, target, poses[pair.source], poses[pair.target], config, seed)

    return each()


def _check_pair(pair: FragmentPair, poses: Mapping[FragmentId, Transform]) -> None:
    if pair.source.area != pair.target.area or pair.source.stage == pair.target.stage:
        raise InputError(
            f"Pair {pair} is not of two stages of one area: only such pairs are refined."
        )
    for fragment in (pair.source, pair.target):
        if fragment not in poses:
            raise InputError(f"Fragment {fragment} of pair {pair} has no pose.")


def _refine_cut(cut: _Cut) -> RefinedPair:
    return _align_cut(cut).result


def _align_cut(cut: _Cut) -> _Aligned:
    config = cut.config
    found = refine(
        cut.source.surface(cut.middle),
        cut.target.surface(cut.middle),
        np.eye(4),
        config.max_distance,
        config.iterations,
        kernel=config.kernel,
    )
    correction = found.T_target_source
    deviation = _deviation(found)
    reason = _reason(found, deviation, config)
    return _Aligned(
        correction,
        RefinedPair(
            T_target_source=_relative(cut, np.eye(4) if reason else correction),
            reason=reason,
            translation=float(np.linalg.norm(correction[:3, 3])),
            rotation=rotation_angle(correction),
            rmse=found.rmse,
            correspondences=found.correspondences,
            deviation=deviation,
        ),
    )


def _relative(cut: _Cut, correction: Transform) -> Transform:
    shift = np.eye(4)
    shift[:3, 3] = cut.middle
    corrected = shift @ correction @ inverse(shift) @ cut.T_map_source
    return relative(corrected, cut.T_map_target)


def _deviation(found: Refined) -> float:
    if found.correspondences == 0 or np.linalg.cond(found.information) > 1e10:
        return float("inf")
    covariance = np.linalg.inv(found.information)
    return float(np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1]))


def _reason(found: Refined, deviation: float, config: RefinementConfig) -> str:
    translation = float(np.linalg.norm(found.T_target_source[:3, 3]))
    rotation = np.degrees(rotation_angle(found.T_target_source))
    if found.correspondences < config.min_correspondences:
        return f"only {found.correspondences} correspondences"
    if not found.converged:
        return "ICP did not converge"
    if deviation > config.max_deviation:
        return f"the overlap leaves {deviation:.3f} m of freedom"
    if translation > config.max_translation or rotation > config.max_rotation:
        return f"a correction of {translation:.2f} m and {rotation:.1f} degrees is not believed"
    return ""


def _by_stages(pair: FragmentPair) -> tuple[object, ...]:
    source, target = pair.source, pair.target
    return source.area, source.stage, target.stage, source.spot, target.spot


@dataclass(frozen=True, slots=True)
class _Ends:
    """The spots of a pair about their middle, (2, 3), and the true correction of them."""

    spots: NDArray[np.float64]
    correction: Transform | None


def _true_alignment(
    pair: FragmentPair,
    poses: Mapping[FragmentId, Transform],
    truth: Mapping[FragmentId, Transform] | None,
) -> _Ends:
    source, target = poses[pair.source], poses[pair.target]
    middle = (source[:3, 3] + target[:3, 3]) / 2
    spots = np.array([source[:3, 3], target[:3, 3]]) - middle
    if truth is None:
        return _Ends(spots, None)
    # The true relative transform as a correction of the source in the map frame.
    shift = np.eye(4)
    shift[:3, 3] = middle
    T_target_source = relative(truth[pair.source], truth[pair.target])
    correction = inverse(shift) @ target @ T_target_source @ inverse(source) @ shift
    return _Ends(spots, correction)


def _statistics(
    radius: float,
    index: int,
    trials: Sequence[Sequence[Sequence[_Aligned]]],
    ends: Sequence[_Ends],
) -> RadiusStatistics:
    firsts = [pair[index][0].result for pair in trials]
    moved = [
        [np.array([moved_by(each.correction, end.spots) for each in repeats]) for repeats in pair]
        for pair, end in zip(trials, ends, strict=True)
    ]
    here = [pair[index].mean(axis=0) for pair in moved]
    spreads = [_rms(pair[index] - mean) for pair, mean in zip(moved, here, strict=True)]
    steps = [
        _rms(mean - pair[index - 1].mean(axis=0)) if index else np.nan
        for pair, mean in zip(moved, here, strict=True)
    ]
    errors = [
        np.nan if end.correction is None else _rms(mean - moved_by(end.correction, end.spots))
        for mean, end in zip(here, ends, strict=True)
    ]
    return RadiusStatistics(
        radius=radius,
        pairs=len(firsts),
        accepted=float(np.mean([each.accepted for each in firsts])),
        rmse=float(np.median([each.rmse for each in firsts])),
        correspondences=float(np.median([each.correspondences for each in firsts])),
        translation=float(np.median([each.translation for each in firsts])),
        rotation=float(np.median([each.rotation for each in firsts])),
        spread=float(np.median(spreads)),
        step=float(np.median(steps)),
        error=float(np.sqrt(np.mean(np.square(errors)))),
    )


def _rms(vectors: NDArray[np.float64]) -> float:
    """Root mean square length of vectors (..., 3)."""
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=-1))))
