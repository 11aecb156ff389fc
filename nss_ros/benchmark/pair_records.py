"""Every pair of a run with what became of it, worst first: what failures are looked up in."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np

from nss_ros.bag import Log
from nss_ros.benchmark.evaluation import Evaluation
from nss_ros.benchmark.metrics import successes
from nss_ros.fragment import FragmentPair
from nss_ros.multiway.pose_graph import Edge, EdgeKind, EdgeStatus
from nss_ros.registration.relative_transform import RelativeTransform

NAN = float("nan")


class Outcome(IntEnum):
    """What became of a pair, worst first."""

    WRONG = 0
    FAILED = 1
    UNANSWERED = 2
    UNKNOWN = 3
    RIGHT = 4

    @property
    def word(self) -> str:
        """For people."""
        return {
            Outcome.WRONG: "wrong",
            Outcome.FAILED: "failed",
            Outcome.UNANSWERED: "no answer",
            Outcome.UNKNOWN: "answered",
            Outcome.RIGHT: "right",
        }[self]


@dataclass(frozen=True, slots=True)
class PairRecord:
    """A pair and what became of it; NaN for what is not known.

    Attributes:
        pair: source and target.
        outcome: right is within 10 deg and 0.2 m; unknown without ground truth of the pair.
        same_stage: both fragments are of one stage.
        overlap_ratio: of the ground truth.
        temporal_change: of the ground truth.
        rre: of the answer, degrees.
        rte: of the answer, metres.
        rmse: of the answer, metres.
        map_rre: of the map's poses, degrees.
        map_rte: of the map's poses, metres.
        confidence: as reported.
        reason: why it failed, or why the map rejected it; empty else.
        in_map: `accepted`, `rejected` or `failed`; empty if it is not in the map.
        edge: row of the evaluation's edges; None if the ground truth has no such edge.
    """

    pair: FragmentPair
    outcome: Outcome
    same_stage: bool
    overlap_ratio: float = NAN
    temporal_change: float = NAN
    rre: float = NAN
    rte: float = NAN
    rmse: float = NAN
    map_rre: float = NAN
    map_rte: float = NAN
    confidence: float = NAN
    reason: str = ""
    in_map: str = ""
    edge: int | None = None

    @property
    def stages(self) -> str:
        """Of source and target."""
        return f"{self.pair.source.stage} → {self.pair.target.stage}"

    @property
    def error(self) -> float:
        """How wrong it is: 1 at the limits of a success; NaN if not known."""
        return float(np.fmax(self.rte / 0.2, self.rre / 10))


def pair_records(log: Log, evaluation: Evaluation | None) -> list[PairRecord]:
    """All pairs that are an edge of the ground truth, were asked for or answered; worst first.

    Args:
        log: of the run.
        evaluation: of the same log; None without ground truth.
    """
    records: dict[FragmentPair, PairRecord] = {}
    edges = log.pose_graph.edges if log.pose_graph else ()
    # What became of the answer to a pair; submaps may have given it another transform.
    placed = {edge.pair: edge for edge in edges if edge.kind is not EdgeKind.SUBMAP}
    if evaluation is not None:
        for i, pair in enumerate(evaluation.edges.pairs):
            if pair not in records:
                records[pair] = _of_edge(log, evaluation, i, placed)
    errors = (
        {pair: i for i, pair in enumerate(evaluation.answers.pairs)}
        if evaluation is not None
        else {}
    )
    for pair in dict.fromkeys((*log.pairs, *log.relative_transforms)):
        if pair in records or FragmentPair(pair.target, pair.source) in records:
            continue
        answer = log.relative_transforms.get(pair)
        rre = rte = NAN
        if evaluation is not None and pair in errors:
            rre = float(evaluation.answers.rre[errors[pair]])
            rte = float(evaluation.answers.rte[errors[pair]])
        records[pair] = PairRecord(
            pair,
            _outcome(answer, rre, rte),
            pair.same_stage,
            rre=rre,
            rte=rte,
            **_told(answer, placed.get(pair)),
        )
    return sorted(records.values(), key=_badness)


def _of_edge(
    log: Log, evaluation: Evaluation, i: int, placed: dict[FragmentPair, Edge]
) -> PairRecord:
    edges = evaluation.edges
    pair = edges.pairs[i]
    turned = FragmentPair(pair.target, pair.source)
    answer = log.relative_transforms.get(pair) or log.relative_transforms.get(turned)
    rre, rte = float(edges.pairwise.rre[i]), float(edges.pairwise.rte[i])
    multiway = edges.multiway
    return PairRecord(
        pair,
        _outcome(answer, rre, rte),
        bool(edges.same_stage[i]),
        float(edges.overlap_ratio[i]),
        float(edges.temporal_change[i]),
        rre,
        rte,
        float(edges.pairwise.rmse[i]),
        NAN if multiway is None else float(multiway.rre[i]),
        NAN if multiway is None else float(multiway.rte[i]),
        edge=i,
        **_told(answer, placed.get(pair) or placed.get(turned)),
    )


def _outcome(answer: RelativeTransform | None, rre: float, rte: float) -> Outcome:
    if answer is None:
        return Outcome.UNANSWERED
    if not answer.ok:
        return Outcome.FAILED
    if np.isnan(rte):
        return Outcome.UNKNOWN
    right = bool(successes(np.array([rre]), np.array([rte]))[0])
    return Outcome.RIGHT if right else Outcome.WRONG


def _told(answer: RelativeTransform | None, edge: Edge | None) -> dict[str, Any]:
    """What the method and the map said."""
    reason = ""
    if answer is not None and not answer.ok:
        reason = answer.message or answer.reason.name.lower().replace("_", " ")
    elif edge is not None and edge.status is not EdgeStatus.ACCEPTED:
        reason = edge.reason
    return {
        "confidence": answer.confidence if answer is not None and answer.ok else NAN,
        "reason": reason,
        "in_map": edge.status.name.lower() if edge is not None else "",
    }


def _badness(record: PairRecord) -> tuple[int, float, FragmentPair]:
    return record.outcome, -record.error if np.isfinite(record.error) else 0.0, record.pair
