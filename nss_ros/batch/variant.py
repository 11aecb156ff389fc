"""Variants of registration methods, each run on the same pairs with the same seeds.

A variant is a method with other settings, or on perturbed fragments. Each has a process of its
own, whose workers are measured, so that no variant finds anything warm.
"""

from __future__ import annotations

import resource
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from nss_ros.bag import Log
from nss_ros.batch.journal import Journal
from nss_ros.batch.pair_sample import PairSample
from nss_ros.batch.registering import Workforce, register_missing
from nss_ros.batch.run import registration_config
from nss_ros.batch.timing import Timing, timing_of
from nss_ros.benchmark.bootstrap import Bootstrap
from nss_ros.benchmark.classification import MIN_OVERLAP
from nss_ros.benchmark.evaluation import evaluate
from nss_ros.benchmark.metrics import recall, rotation_error, successes, translation_error
from nss_ros.benchmark.overlap_truth import COMPLETE_KEY
from nss_ros.benchmark.score import LogScore, summarize
from nss_ros.config import NssConfig, load_config
from nss_ros.dataset.bag_export import ground_truth_graph
from nss_ros.dataset.folder import DatasetFolder
from nss_ros.dataset.perturbation import Perturbation, PerturbedDataset
from nss_ros.fragment import FragmentPair
from nss_ros.geometry import Transform
from nss_ros.multiway.pose_graph import EdgeKind, PoseGraph
from nss_ros.parallel import end_workers
from nss_ros.registration.method import load_method
from nss_ros.registration.relative_transform import RelativeTransform
from nss_ros.worker_process import stop_now, worker_pool

_MEBIBYTE = 2**10  # of what the operating system counts in, KiB
_KINDS = {EdgeKind.SAME_STAGE: "same_stage", EdgeKind.DIFFERENT_STAGE: "different_stage"}


@dataclass(frozen=True, slots=True)
class Variant:
    """What is run.

    Attributes:
        method: of registration, by registered name.
        overrides: settings, `section.name=value`, that tell it from others.
        perturbation: of every fragment.
        common: settings that all variants have; overrides win over them.
        label: what the overrides are called; empty: as they are.
    """

    method: str
    overrides: tuple[str, ...] = ()
    perturbation: Perturbation = field(default_factory=Perturbation)
    common: tuple[str, ...] = ()
    label: str = ""

    def __str__(self) -> str:
        settings = [override.removeprefix("registration.") for override in self.overrides]
        parts = (self.method, *([self.label] if self.label else settings), str(self.perturbation))
        return ", ".join(part for part in parts if part)

    def config(self) -> NssConfig:
        """All settings.

        Raises:
            ConfigError: an override is not valid.
        """
        return load_config(None, (*self.common, *self.overrides))


@dataclass(frozen=True, slots=True)
class VariantResult:
    """What a variant gave.

    Attributes:
        name: of the variant.
        score: of its answers.
        among: recall of whoever picks the right one of each answer's hypotheses where there is
            one, percent, by kind; NaN of no pair.
        timing: seconds, with one thread.
        memory: most memory of a worker process, with all libraries it has loaded, MiB.
    """

    name: str
    score: LogScore
    among: Mapping[str, float]
    timing: Timing
    memory: float


def run_variants(
    dataset: Path,
    sample: PairSample,
    variants: Sequence[Variant],
    bootstrap: Bootstrap,
    workers: int = 1,
    report: Callable[[int], None] = lambda _: None,
) -> Iterator[VariantResult]:
    """Run variants one after the other, each in a fresh process.

    Args:
        dataset: folder, with pairs.
        sample: the pairs that all register.
        variants: in order.
        bootstrap: of the intervals.
        workers: worker processes of each variant.
        report: called with how many variants are done.

    Raises:
        ConfigError: a setting is not valid.
        MethodError: a method is not installed, or lacks something.
        FormatError: a fragment cannot be read.
    """
    for variant in variants:  # refuses before anything is done
        load_method(registration_config(variant.config(), variant.method))
    for number, variant in enumerate(variants, start=1):
        pool = worker_pool(1)
        try:
            result = pool.submit(run_variant, dataset, sample, variant, bootstrap, workers).result()
            pool.shutdown()  # what joblib left is removed by the process itself
        finally:
            stop_now(pool)
        yield result
        report(number)


def run_variant(
    path: Path, sample: PairSample, variant: Variant, bootstrap: Bootstrap, workers: int
) -> VariantResult:
    """Run a variant; the memory is the most of all that this process ever waited for.

    Args:
        path: folder of the dataset, with pairs.
        sample: the pairs that it registers.
        variant: method, settings and perturbation.
        bootstrap: of the intervals.
        workers: worker processes.
    """
    dataset = PerturbedDataset(DatasetFolder(path), variant.perturbation)
    config = registration_config(variant.config(), variant.method)
    pairs = sample.pairs
    with TemporaryDirectory() as work, Journal(Path(work) / "journal") as journal:
        force = Workforce(workers)
        register_missing(
            dataset, pairs, config, journal, Path(work) / "features", force, lambda *_: None
        )
        if workers != 1:
            end_workers()  # the memory of a process is told when it has ended
        timing = timing_of(journal, variant.method, pairs)
        answers = {pair: journal.of(variant.method)[pair].result for pair in pairs}
    truth = tuple(
        variant.perturbation.ground_truth(ground_truth_graph(dataset, area, sample.overlapping))
        for area in dataset.areas()
    )
    # Of the sampled pairs every one that overlaps has an edge.
    metadata = {COMPLETE_KEY: str(MIN_OVERLAP)}
    log = Log(
        Path(str(variant)),
        pairs=pairs,
        relative_transforms=answers,
        ground_truth=truth,
        metadata=metadata,
    )
    return VariantResult(
        str(variant),
        summarize(evaluate(log), bootstrap),
        recall_among(answers, truth),
        timing,
        resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / _MEBIBYTE,
    )


def recall_among(
    answers: Mapping[FragmentPair, RelativeTransform], truth: Sequence[PoseGraph]
) -> dict[str, float]:
    """Recall of whoever picks the right one of each answer's hypotheses, percent, by kind.

    Args:
        answers: with their alternatives.
        truth: graphs, whose edges count.
    """
    found: dict[EdgeKind, list[bool]] = {kind: [] for kind in _KINDS}
    for edge in (edge for graph in truth for edge in graph.edges):
        answer = answers.get(edge.pair)
        right = answer is not None and answer.ok and _has_right(answer, edge.T_target_source)
        found[edge.kind].append(right)
    return {_KINDS[kind]: recall(np.array(right, dtype=bool)) for kind, right in found.items()}


def _has_right(answer: RelativeTransform, ground_truth: Transform) -> bool:
    listed = [answer.T_target_source, *(each.T_target_source for each in answer.alternatives)]
    estimates = np.array(listed)
    rre = rotation_error(ground_truth, estimates)
    return bool(successes(rre, translation_error(ground_truth, estimates)).any())
