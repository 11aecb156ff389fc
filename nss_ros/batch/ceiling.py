"""What alignment alone can reach: ICP that begins at the true pose.

Ground truth is what it begins with, so this is a ceiling to compare methods with, no method.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from nss_ros.benchmark.metrics import recall, rotation_error, successes, translation_error
from nss_ros.config import RegistrationConfig
from nss_ros.dataset.bag_export import ground_truth_graph
from nss_ros.dataset.folder import DatasetFolder
from nss_ros.dataset.pairs import PairTable
from nss_ros.fragment import FragmentId, FragmentPair
from nss_ros.geometry import Transform
from nss_ros.parallel import run
from nss_ros.registration.gravity.refinement import Shape, refined_near
from nss_ros.registration.gravity.scan import fitting_scan_of

_SHAPES_KEPT = 64


@dataclass(frozen=True, slots=True)
class _Trial:
    """A pair with its ground truth."""

    dataset: Path
    pair: FragmentPair
    T_target_source: Transform
    config: RegistrationConfig


def recall_from_truth(
    dataset: DatasetFolder, pairs: PairTable, config: RegistrationConfig, workers: int = 1
) -> dict[str, float]:
    """Recall of the ICP of `gravity` that begins at the true pose, percent, by kind.

    Where it goes farther away than the search may be off, nothing is right.

    Args:
        dataset: of levelled fragments.
        pairs: with ground truth.
        config: settings.
        workers: processes.

    Raises:
        FormatError: a fragment cannot be read.
    """
    graphs = [ground_truth_graph(dataset, area, pairs) for area in dataset.areas()]
    trials = [
        _Trial(dataset.path, edge.pair, edge.T_target_source, config)
        for graph in graphs
        for edge in graph.edges
    ]
    right = np.array(list(run(_stays, trials, workers)), dtype=bool)
    same = np.array([trial.pair.same_stage for trial in trials], dtype=bool)
    return {"same_stage": recall(right[same]), "different_stage": recall(right[~same])}


def _stays(trial: _Trial) -> bool:
    source, target = (
        _shape(trial.dataset, id_, trial.config) for id_ in (trial.pair.source, trial.pair.target)
    )
    truth = trial.T_target_source
    found = refined_near(source.coarse, source.moderate, target.surface, truth, trial.config)
    there = found.T_target_source
    # Where ICP was carried away, the pose that it began with is given back.
    stayed = not np.array_equal(there, truth)
    return bool(stayed and successes(rotation_error(truth, there), translation_error(truth, there)))


@lru_cache(maxsize=_SHAPES_KEPT)
def _shape(dataset: Path, id_: FragmentId, config: RegistrationConfig) -> Shape:
    return Shape.of(fitting_scan_of(DatasetFolder(dataset).fragment(id_), config), config)
