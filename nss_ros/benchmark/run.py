"""A recorded run with all that can be told of it, whether or not it can be scored."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from nss_ros.bag import Log, read_log, with_source_points
from nss_ros.benchmark.bootstrap import Bootstrap
from nss_ros.benchmark.evaluation import Evaluation, evaluate
from nss_ros.benchmark.run_timing import RunTiming, timing_of
from nss_ros.benchmark.score import LogScore, summarize
from nss_ros.benchmark.table import notes
from nss_ros.multiway.pose_graph import doubtful_sentence


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """A log, and what was measured of it.

    Attributes:
        log: with point clouds if they are in the log or in the bags it was made from.
        timing: when what came.
        evaluation: against the ground truth; None if the log cannot be scored.
        score: of the evaluation; None as well.
        notes: one sentence for each thing that is missing.
    """

    log: Log
    timing: RunTiming
    evaluation: Evaluation | None
    score: LogScore | None
    notes: tuple[str, ...]

    @property
    def name(self) -> str:
        """Of the log, for headings."""
        return self.log.path.resolve().name


def read_run(path: Path, bootstrap: Bootstrap | None = None) -> Run:
    """Read and measure a log.

    Raises:
        BagError: there is no log, or it cannot be read.
    """
    log = read_log(path)
    return measured_run(with_source_points(log), timing_of(log), bootstrap)


def measured_run(log: Log, timing: RunTiming, bootstrap: Bootstrap | None = None) -> Run:
    """Measure a log as far as it goes.

    Args:
        log: with whatever it holds.
        timing: of the same log.
        bootstrap: how intervals are found; None: as `Bootstrap` has it.
    """
    truth = any(graph.edges or graph.poses() for graph in log.ground_truth)
    scorable = truth and (log.relative_transforms or log.pose_graph is not None)
    evaluation = evaluate(log) if scorable else None
    score = summarize(evaluation, bootstrap) if evaluation is not None else None
    return Run(log, timing, evaluation, score, tuple(_notes(log, truth, score)))


def _notes(log: Log, truth: bool, score: LogScore | None) -> list[str]:
    result = notes(score) if score is not None else _unscored(log, truth)
    if score is not None and score.overall.pairwise.all.edges == 0:
        result.append("The ground truth has no edges, so there are no errors of pairs.")
    if not log.fragments and (score is None or score.has_points):
        result.append("The log holds no point clouds.")
    if not log.fragments:
        result.append(
            "Without point clouds there are no pictures of the map and of pairs: record with "
            "fragments, or keep the bag that was played where it was, unchanged."
        )
    if log.pose_graph is not None and not log.pose_graph.poses():
        result.append("The map is empty: no fragment was placed.")
    return result


def _unscored(log: Log, truth: bool) -> list[str]:
    result = []
    if log.partial:
        result.append("PARTIAL: the log is truncated or was never closed.")
    if not truth:
        result.append("The log holds no ground truth, so nothing in it is scored.")
    if not log.relative_transforms:
        result.append("The log holds no answers to pairs.")
    if log.pose_graph is None:
        result.append("The log holds no map.")
    elif doubtful := log.pose_graph.doubtful():
        result.append(doubtful_sentence(doubtful))
    return result
