"""Registration methods, and variants of them, on the same pairs of a dataset.

    ./nss simulate demo -o DATASET && ./nss pairs DATASET
    ./nss python benchmarks/registration.py DATASET [--method NAME ...] [--split NAME] [--pairs N]
    ./nss python benchmarks/registration.py DATASET --method gravity --ablations
    ./nss python benchmarks/registration.py DATASET --tilt 1 2 3 --noise 0.01 0.03
    ./nss python benchmarks/registration.py DATASET --floating 0.1 --robot

One row per method and variant: recall with 95 % bootstrap intervals, and that of whoever picks the
right one of each answer's hypotheses; seconds of a pair with the features of its fragments cached
and not, most memory of a worker process, calibration of the confidence, and how well the overlap
probability tells pairs that overlap from as many that do not; then recall by overlap ratio and by
temporal change ratio. All see the same pairs and seeds. Last, what ICP reaches from the true pose.

`--vary METHOD:SETTING=A,B` adds a variant of a method for each value, `--ablations` those in
ABLATIONS and `gravity` without each of its parts, nothing trained anew; `--tilt` and `--noise` each
method on fragments out of level by so many degrees, and with ranges that are off by a standard
deviation of so many metres, `--floating` with so many points in empty air, as a share of all, and
`--robot` with the body of a robot that carries the scanner.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import asdict, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from nss_ros.batch.pair_sample import PairSample
    from nss_ros.batch.variant import Variant, VariantResult

ABLATIONS = (
    "gravity:registration.gravity.hypotheses=6,12,48",
    "kiss_matcher:registration.kiss_matcher.yaw_only=false",
    "fpfh_ransac:registration.fpfh.use_gravity=false",
)


def main() -> None:
    """Measure and print tables."""
    arguments = parser().parse_args()

    from rich.console import Console

    from nss_ros.cli.output import print_json
    from nss_ros.cli.table_format import TableFormat, print_tables
    from nss_ros.errors import NssError

    try:
        sample = chosen_pairs(arguments)
        results = measure(arguments, sample)
        ceiling = from_truth(arguments, sample)
    except NssError as error:
        sys.exit(f"error: {error}")
    if arguments.json:
        variants = [asdict(result) for result in results]
        print_json({"variants": variants, "icp_from_truth": ceiling})
        return
    from nss_ros.batch.variant_table import variant_tables

    form = TableFormat.MARKDOWN if arguments.markdown else TableFormat.RICH
    print_tables(variant_tables(results), [], form)
    same, different = ceiling.values()
    print(f"\nICP that begins at the true pose: {same:.1f} / {different:.1f} % (same / different).")
    Console(stderr=True).print("./nss python " + " ".join(sys.argv), highlight=False)


def parser() -> argparse.ArgumentParser:
    """What the command line takes."""
    result = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    result.add_argument("dataset", type=Path, help="with pairs, from 'nss pairs'")
    result.add_argument("--method", action="append", default=[], help="default: all that can run")
    result.add_argument("--split", default="all", help="its test pairs; default: all pairs")
    result.add_argument("--pairs", type=int, default=200, help="most pairs of each kind")
    result.add_argument("--apart", type=int, help="pairs that do not overlap; default: as --pairs")
    result.add_argument("--seed", type=int, default=0, help="of the sample, and of all variants")
    result.add_argument("--workers", type=int, default=1, help="processes")
    result.add_argument("--set", action="append", default=[], help="section.name=value, for all")
    result.add_argument("--vary", action="append", default=[], help="METHOD:SETTING=A,B")
    result.add_argument("--ablations", action="store_true", help="also vary as ABLATIONS say")
    result.add_argument("--tilt", type=float, nargs="+", default=[], help="degrees")
    result.add_argument("--noise", type=float, nargs="+", default=[], help="metres")
    result.add_argument("--floating", type=float, nargs="+", default=[], help="share of points")
    result.add_argument("--robot", action="store_true", help="also on a robot that is seen")
    form = result.add_mutually_exclusive_group()
    form.add_argument("--markdown", action="store_true", help="print tables as Markdown")
    form.add_argument("--json", action="store_true", help="print all figures as JSON")
    return result


def measure(arguments: argparse.Namespace, sample: PairSample) -> list[VariantResult]:
    """The results of all variants, in the order of the table."""
    from nss_ros.batch.variant import run_variants
    from nss_ros.benchmark.bootstrap import Bootstrap
    from nss_ros.cli.progress import progress_bar

    with TemporaryDirectory() as weights, progress_bar(quiet=arguments.json) as bar:
        variants = list(chosen_variants(arguments, Path(weights)))
        refuse_learned(arguments, variants)
        task = bar.add_task("variants", total=len(variants))
        return list(
            run_variants(
                arguments.dataset,
                sample,
                variants,
                Bootstrap(seed=arguments.seed),
                arguments.workers,
                lambda done: bar.update(task, completed=done),
            )
        )


def from_truth(arguments: argparse.Namespace, sample: PairSample) -> dict[str, float]:
    """What ICP reaches that begins at the true pose, percent, of the same pairs."""
    from nss_ros.batch.ceiling import recall_from_truth
    from nss_ros.config import load_config
    from nss_ros.dataset.folder import DatasetFolder

    config = load_config(None, arguments.set).registration
    dataset = DatasetFolder(arguments.dataset)
    return recall_from_truth(dataset, sample.overlapping, config, arguments.workers)


def chosen_pairs(arguments: argparse.Namespace) -> PairSample:
    """The pairs that all variants register."""
    from nss_ros.batch.pair_sample import PairSample, sample_apart, sample_overlapping
    from nss_ros.batch.plan import planned
    from nss_ros.batch.source import BatchSplit, DatasetSource, PairChoice
    from nss_ros.benchmark.classification import MIN_OVERLAP
    from nss_ros.dataset.folder import PAIRS_NAME, DatasetFolder
    from nss_ros.dataset.pairs import read_pairs

    dataset = DatasetFolder(arguments.dataset)
    split = BatchSplit(arguments.split)
    plan = planned(DatasetSource(dataset), [split], PairChoice.OVERLAPPING, MIN_OVERLAP)
    apart = arguments.pairs if arguments.apart is None else arguments.apart
    return PairSample(
        sample_overlapping(plan.splits[split], arguments.pairs, arguments.seed),
        sample_apart(
            dataset.fragment_ids(), read_pairs(dataset.path / PAIRS_NAME), apart, arguments.seed
        ),
    )


def chosen_variants(arguments: argparse.Namespace, weights: Path) -> Iterator[Variant]:
    """Each method as it is, with other settings, and on perturbed fragments.

    Args:
        arguments: of the command line.
        weights: folder for the weights of `gravity` without its parts.
    """
    from nss_ros.batch.variant import Variant
    from nss_ros.dataset.perturbation import Perturbation

    common = (f"registration.seed={arguments.seed}", *arguments.set)
    wanted = [*arguments.vary, *(ABLATIONS if arguments.ablations else ())]
    perturbations = [Perturbation(tilt=tilt, seed=arguments.seed) for tilt in arguments.tilt]
    perturbations += [Perturbation(range_noise=m, seed=arguments.seed) for m in arguments.noise]
    perturbations += [Perturbation(floating=f, seed=arguments.seed) for f in arguments.floating]
    perturbations += [Perturbation(robot=True, seed=arguments.seed)] if arguments.robot else []
    for method in arguments.method or usable_methods(common):
        yield Variant(method, common=common)
        for override in overrides_of(method, wanted):
            yield Variant(method, (override,), common=common)
        if method == "gravity" and arguments.ablations:
            yield from (replace(each, common=common) for each in parts_taken_away(weights))
        for perturbation in perturbations:
            yield Variant(method, perturbation=perturbation, common=common)


def refuse_learned(arguments: argparse.Namespace, variants: Sequence[Variant]) -> None:
    """End where weights may have learned from the pairs that are measured."""
    from nss_ros.batch.learned_from import learned_from
    from nss_ros.batch.run import registration_config
    from nss_ros.batch.source import BatchSplit, DatasetSource
    from nss_ros.dataset.folder import DatasetFolder
    from nss_ros.registration.method import load_method

    source, splits = DatasetSource(DatasetFolder(arguments.dataset)), [BatchSplit(arguments.split)]
    for variant in variants:
        method = load_method(registration_config(variant.config(), variant.method))
        learned_from(variant.method, method, source, splits)


def usable_methods(common: tuple[str, ...]) -> list[str]:
    """The installed methods that have what they need; tells of the others."""
    from nss_ros.batch.run import registration_config
    from nss_ros.batch.variant import Variant
    from nss_ros.errors import MethodError
    from nss_ros.registration.method import load_method, method_names

    usable = []
    for method in method_names():
        try:
            load_method(registration_config(Variant(method, common=common).config(), method))
        except MethodError as error:
            print(f"{method} is left out: {error}", file=sys.stderr)
        else:
            usable.append(method)
    return usable


def parts_taken_away(folder: Path) -> Iterator[Variant]:
    """`gravity` without each of its parts, whose weights are written to a folder."""
    from nss_ros.batch.variant import Variant
    from nss_ros.registration.gravity.ablation import ABLATIONS as PARTS
    from nss_ros.registration.gravity.weights import load_weights, save_weights

    for number, (label, take_away) in enumerate(PARTS.items()):
        path = folder / f"{number}.safetensors"
        save_weights(path, take_away(load_weights()))
        yield Variant("gravity", (f"registration.gravity.weights={path}",), label=label)


def overrides_of(method: str, wanted: Sequence[str]) -> Iterator[str]:
    """The overrides of a method among `METHOD:SETTING=A,B`, one for each value."""
    for each in wanted:
        name, _, rest = each.partition(":")
        setting, separator, values = rest.partition("=")
        if not separator:
            sys.exit(f"error: --vary {each}: give METHOD:SETTING=A,B.")
        if name == method:
            yield from (f"{setting}={value}" for value in values.split(","))


if __name__ == "__main__":
    main()
