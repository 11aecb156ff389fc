"""A benchmark: methods over the pairs and splits of a dataset, then maps, then logs.

A benchmark that was killed goes on where it was: pairs that have an answer in the journal, and
logs that are there, are not made again. Pairs whose worker died are tried again, and the logs that
hold such an answer are made anew when there is a better one.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

from nss_ros.bag_reader import bag_digest, read_metadata
from nss_ros.batch.folder import ResultsFolder
from nss_ros.batch.journal import Entry, Journal
from nss_ros.batch.learned_from import learned_from
from nss_ros.batch.mapping import AreaTask, area_map, joined_maps
from nss_ros.batch.plan import Plan, planned
from nss_ros.batch.registering import Report, Workforce, register_missing
from nss_ros.batch.run_log import write_log
from nss_ros.batch.source import BatchSplit, PairChoice, Source
from nss_ros.batch.timing import Timing, timing_of
from nss_ros.benchmark.evaluation import SPLIT_KEY, TRAINING_KEY
from nss_ros.config import MultiwayConfig, NssConfig, RegistrationConfig
from nss_ros.files import file_digest
from nss_ros.multiway.pose_graph import PoseGraph
from nss_ros.multiway.synchronizer import find_synchronizer, load_synchronizer
from nss_ros.parallel import run
from nss_ros.registration.method import Method, find_method, load_method
from nss_ros.versions import run_versions

DIED_KEY = "benchmark.worker_died"
"""Metadata of a log: in how many of its pairs the worker died; not there if in none."""

_PAIRWISE = "pairwise"
_INDIFFERENT = ("start_time", "platform")
"""Versions that a benchmark may go on with when they differ."""


@dataclass(frozen=True, slots=True)
class Choice:
    """What is run.

    Attributes:
        methods: of registration, by registered name.
        splits: whose test pairs are registered.
        synchronizers: multi-way methods, by registered name; none: pairs only.
        pairs: the selected pairs, or all that overlap.
        training: what the methods were trained on, for the tables; empty: not told.
    """

    methods: Sequence[str]
    splits: Sequence[BatchSplit]
    synchronizers: Sequence[str]
    pairs: PairChoice = PairChoice.SELECTED
    training: str = ""


@dataclass(frozen=True, slots=True)
class RunLog:
    """A log that was written.

    Attributes:
        path: its folder.
        split: whose pairs.
        method: of registration.
        synchronizer: multi-way method; empty: none.
    """

    path: Path
    split: str
    method: str
    synchronizer: str


@dataclass(frozen=True, slots=True)
class BatchResult:
    """What a benchmark gave.

    Attributes:
        logs: by split, method and synchronizer, in the order that was asked for.
        timings: one per method.
        problems: one sentence for each map that could not be made; its log is missing.
    """

    logs: tuple[RunLog, ...]
    timings: tuple[Timing, ...]
    problems: tuple[str, ...]


def run_benchmark(
    source: Source,
    output: Path,
    choice: Choice,
    config: NssConfig,
    force: Workforce,
    report: Report = lambda *_: None,
) -> BatchResult:
    """Run methods over a dataset, or finish what a killed run began.

    Args:
        source: a dataset with pairs, or a bag.
        output: folder of the results.
        choice: what is run.
        config: settings of registration and multi-way methods, least overlap.
        force: who computes.
        report: called with a name for people, how many are done, and how many there are.

    Raises:
        InputError: the dataset, the splits or the folder do not fit.
        MethodError: a method is not installed, or lacks something.
        FormatError: a file cannot be read or written.
    """
    registrations = {
        name: registration_config(config, name) for name in dict.fromkeys(choice.methods)
    }
    # Loaded to be refused before anything is done, if at all.
    trained = {
        name: _training(name, load_method(each), source, choice)
        for name, each in registrations.items()
    }
    for name in choice.synchronizers:
        load_synchronizer(_multiway(config, name))
    plan = planned(source, choice.splits, choice.pairs, config.dataset.pairs.min_overlap)
    folder = ResultsFolder(output)
    settings = _settings(source, choice, config)
    with folder.opened(settings, run_versions()) as versions, Journal(folder.journal) as journal:
        for name, registration in registrations.items():
            register_missing(
                source,
                plan.pairs,
                registration,
                journal,
                folder.work,
                force,
                _of_method(report, name),
            )
        writer = _Writer(source, folder, plan, choice, config, journal, versions, trained)
        result = writer.write(force, report)
        folder.finish()
    return result


def _training(name: str, method: Method, source: Source, choice: Choice) -> str:
    """What a method was trained on, as asked for or as its weights tell; empty: not told.

    Raises:
        InputError: pairs that are registered are among those that it learned from.
    """
    record = learned_from(name, method, source, choice.splits)
    return choice.training or (record.stages if record else "")


def _of_method(report: Report, method: str) -> Report:
    return lambda what, done, total: report(f"{what} {method}", done, total)


@dataclass(frozen=True, slots=True)
class _Writer:
    """Makes maps and logs of what the journal holds."""

    source: Source
    folder: ResultsFolder
    plan: Plan
    choice: Choice
    config: NssConfig
    journal: Journal
    versions: dict[str, str]
    trained: dict[str, str]

    def write(self, force: Workforce, report: Report) -> BatchResult:
        """Write the logs that are missing."""
        logs = self._logs()
        missing = [log for log in logs if not self._is_current(log)]
        problems = []
        if missing:
            common = self._metadata()
            maps = self._maps(missing, force)
            report("logs", len(logs) - len(missing), len(logs))
            for number, (log, map_) in enumerate(zip(missing, maps, strict=True), start=1):
                if isinstance(map_, str):
                    problems.append(
                        f"The synchronizer '{log.synchronizer}' made no map of the split "
                        f"{log.split} with {log.method}: {map_}"
                    )
                    continue
                self._write_log(log, map_, common)
                report("logs", len(logs) - len(missing) + number, len(logs))
        written = tuple(log for log in logs if log.path.exists())
        timings = (
            timing_of(self.journal, method, self.plan.pairs)
            for method in dict.fromkeys(self.choice.methods)
        )
        return BatchResult(written, tuple(timings), tuple(problems))

    def _logs(self) -> list[RunLog]:
        return [
            RunLog(self.folder.logs / _file_name(split, method, name), split, method, name)
            for split in self.plan.splits
            for method in dict.fromkeys(self.choice.methods)
            for name in dict.fromkeys(self.choice.synchronizers or ("",))
        ]

    def _is_current(self, log: RunLog) -> bool:
        """Whether the log is there, with the answers of the journal.

        Only pairs whose worker died get another answer, so that as many are left tells it.
        """
        if not log.path.exists():
            return False
        return read_metadata(log.path).get(DIED_KEY, "0") == str(self._died(log))

    def _died(self, log: RunLog) -> int:
        answers = self.journal.of(log.method)
        return sum(
            not answers[pair].final for pair in self.plan.splits[BatchSplit(log.split)].pairs
        )

    def _maps(self, logs: Sequence[RunLog], force: Workforce) -> list[PoseGraph | str | None]:
        """The map of each log; a sentence where it could not be made, None without."""
        tasks = {log: self._tasks(log) for log in logs if log.synchronizer}
        # On this machine: an area takes seconds, and its answers would have to travel.
        made = run(area_map, (task for each in tasks.values() for task in each), force.here)
        maps: list[PoseGraph | str | None] = []
        for log in logs:
            parts = [next(made) for _ in tasks.get(log, ())]
            graphs = [part for part in parts if isinstance(part, PoseGraph)]
            reasons = [part for part in parts if isinstance(part, str)]
            maps.append(reasons[0] if reasons else joined_maps(graphs) if graphs else None)
        return maps

    def _tasks(self, log: RunLog) -> list[AreaTask]:
        table = self.plan.splits[BatchSplit(log.split)]
        answers = self.journal.of(log.method)
        config = _multiway(self.config, log.synchronizer)
        return [
            AreaTask(
                config,
                self.source.path,
                part.fragments,
                tuple(answers[pair].result for pair in part.pairs),
            )
            for part in self.source.parts(table)
        ]

    def _write_log(self, log: RunLog, map_: PoseGraph | None, common: dict[str, str]) -> None:
        table = self.plan.splits[BatchSplit(log.split)]
        answers = self.journal.of(log.method)
        truth = self.source.ground_truth(table)
        chosen = {
            "registration": {"method": log.method},
            "pose_graph": {"synchronizer": log.synchronizer or self.config.pose_graph.synchronizer},
        }
        config = self.config.model_copy(
            update={
                name: getattr(self.config, name).model_copy(update=values)
                for name, values in chosen.items()
            }
        )
        own = {
            SPLIT_KEY: log.split,
            TRAINING_KEY: self.trained[log.method],
            "benchmark.pairs": self.choice.pairs.value,
            "benchmark.method": log.method,
            "benchmark.synchronizer": log.synchronizer,
            "benchmark.seed": str(self.config.registration.seed),
            DIED_KEY: str(self._died(log) or ""),
            "config": config.model_dump_json(),
        }
        timing = timing_of(self.journal, log.method, self.plan.pairs)
        own |= {
            "benchmark.prepare_seconds": repr(timing.prepare),
            "benchmark.register_seconds": repr(timing.register),
        }
        entries: list[Entry] = [answers[pair] for pair in table.pairs]
        metadata = {name: value for name, value in own.items() if value}
        write_log(log.path, self.folder.begun, truth, entries, map_, common | metadata)

    def _metadata(self) -> dict[str, str]:
        """What all logs tell: of the dataset, of the code, and where the point clouds are."""
        bag = self.folder.fragments
        if not bag.exists():
            begun = self.folder.begun / bag.name
            shutil.rmtree(begun, ignore_errors=True)
            self.source.write_fragments(begun)
            begun.rename(bag)
        return {
            **self.source.metadata(),
            **self.versions,
            "bag_0": f"../../{bag.name}",
            "bag_0_sha256": bag_digest(bag),
        }


def _file_name(split: str, method: str, synchronizer: str) -> str:
    return "-".join((split, method, synchronizer or _PAIRWISE)).replace("/", "_")


def registration_config(config: NssConfig, method: str) -> RegistrationConfig:
    """The settings of a method, without those of the node."""
    values = config.registration.model_dump(include=set(RegistrationConfig.model_fields))
    return RegistrationConfig.model_validate(values | {"method": method})


def _multiway(config: NssConfig, synchronizer: str) -> MultiwayConfig:
    values = config.pose_graph.model_dump(include=set(MultiwayConfig.model_fields))
    return MultiwayConfig.model_validate(values | {"synchronizer": synchronizer})


def _settings(source: Source, choice: Choice, config: NssConfig) -> dict[str, Any]:
    """All that results depend on; which methods, splits and synchronizers may grow."""
    registration = registration_config(config, "").model_dump(mode="json")
    multiway = _multiway(config, "").model_dump(mode="json")
    del registration["method"], multiway["synchronizer"]
    plugins = [find_method(name) for name in choice.methods]
    plugins += [find_synchronizer(name) for name in choice.synchronizers]
    return {
        "dataset": source.fingerprint(),
        "pairs": choice.pairs.value,
        "min_overlap": config.dataset.pairs.min_overlap,
        "training": choice.training,
        "registration": registration,
        "pose_graph": multiway,
        "versions": {k: v for k, v in run_versions().items() if k not in _INDIFFERENT},
        "plugins": {each.name: _origin(each) + _weights(config, each.name) for each in plugins},
    }


def _weights(config: NssConfig, method: str) -> str:
    """What tells the file of a registration method's weights; empty if there is none."""
    path: str = getattr(getattr(config.registration, method, None), "weights", "")
    return f" with weights {file_digest(Path(path))}" if path else ""


def _origin(plugin: EntryPoint) -> str:
    package = f" of {plugin.dist.name} {plugin.dist.version}" if plugin.dist else ""
    return f"{plugin.value}{package}"
