"""`nss score`: a log against its ground truth, or challenge files against each other."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from nss_ros.bag import read_log, with_source_points
from nss_ros.benchmark.challenge import ChallengeMetrics, ChallengeScore, score_challenge
from nss_ros.benchmark.clouds import clouds_in
from nss_ros.benchmark.metrics import MAX_RRE, MAX_RTE_CHALLENGE
from nss_ros.benchmark.score import score_log
from nss_ros.benchmark.table import OFFICIAL_NAMES, challenge_tables, log_tables
from nss_ros.cli.output import print_json
from nss_ros.dataset.challenge import read_graphs
from nss_ros.errors import InputError


def score(
    log: Annotated[
        Path | None, typer.Argument(metavar="LOG", help="Log folder, as written by 'nss map'.")
    ] = None,
    target: Annotated[
        Path | None, typer.Option(help="Challenge file with the ground truth, instead of LOG.")
    ] = None,
    prediction: Annotated[
        Path | None, typer.Option(help="Challenge file with the prediction.")
    ] = None,
    points: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="PLY files of the challenge files' nodes; for RMSE."),
    ] = None,
    translation_threshold: Annotated[
        float, typer.Option(min=0, help="Challenge files: largest RTE of a success, metres.")
    ] = MAX_RTE_CHALLENGE,
    rotation_threshold: Annotated[
        float, typer.Option(min=0, help="Challenge files: largest RRE of a success, degrees.")
    ] = MAX_RRE,
    json: Annotated[bool, typer.Option("--json", help="Print the score as JSON.")] = False,
) -> None:
    """Score a log, or a challenge prediction with the challenge's official definitions.

    A log is scored against the ground truth it carries, pairwise and as a map, at 10 degrees with
    0.2 m (the paper's) and with 0.1 m (the challenge's).
    """
    console = Console()
    if log is not None and target is None and prediction is None:
        if points is not None:
            raise InputError("--points belongs to --target and --prediction: a LOG has its own.")
        result = score_log(with_source_points(read_log(log)))
        if json:
            print_json(asdict(result))
        else:
            console.print(log_tables(result))
        return
    if log is not None or target is None or prediction is None:
        raise InputError("Give either a LOG, or both --target and --prediction.")
    official = score_challenge(
        read_graphs(target),
        read_graphs(prediction),
        clouds_in(points) if points is not None else None,
        translation_threshold,
        rotation_threshold,
    )
    if json:
        print_json(_official(official))
    else:
        console.print(challenge_tables(official))


def _official(score: ChallengeScore) -> dict[str, Any]:
    """With the official evaluator's names, so that outputs can be compared as they are."""
    return {
        "scenes": {name: _named(subsets) for name, subsets in score.scenes.items()},
        "overall": _named(score.overall),
        "notes": list(score.notes),
    }


def _named(subsets: Mapping[str, ChallengeMetrics]) -> dict[str, dict[str, float]]:
    return {
        subset: {
            name: getattr(metrics, attribute)
            for attribute, (name, _) in OFFICIAL_NAMES.items()
            if getattr(metrics, attribute) is not None
        }
        for subset, metrics in subsets.items()
    }
