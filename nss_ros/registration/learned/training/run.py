"""Trains a learned baseline on a split of a dataset, into a checkpoint that the method loads."""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from nss_ros import __version__
from nss_ros.config import NssConfig
from nss_ros.dataset.annotate import sets_digest
from nss_ros.dataset.folder import POSES_NAME, DatasetFolder
from nss_ros.dataset.splits import Split
from nss_ros.errors import FormatError, InputError
from nss_ros.files import file_digest, write_file
from nss_ros.registration.learned.checkpoint import chosen_device
from nss_ros.registration.learned.training.example import ExampleSource, training_pairs
from nss_ros.registration.learned.training.loop import Report, Trainer
from nss_ros.registration.learned.training.trainee import new_trainee
from nss_ros.registration.learned.training_record import RECORD_KEY, TrainingRecord

# Keeps what is drawn for validation apart from what is learned from.
_LEARNED, _VALIDATED = 0, 1


@dataclass(frozen=True, slots=True)
class Training:
    """What is trained on what.

    Attributes:
        dataset: with `pairs.csv`.
        method: registered name.
        split: whose training pairs.
        same_stage_only: whether pairs of different stages are left out.
        seed: of everything random.
    """

    dataset: DatasetFolder
    method: str
    split: Split
    same_stage_only: bool
    seed: int


def train(
    training: Training,
    output: Path,
    config: NssConfig,
    report: Callable[[Report], None] = lambda _: None,
) -> TrainingRecord:
    """Train a method, or finish what a killed run began.

    Until it is done, what is needed to go on lies beside the output, in `<output>.partial`.

    Args:
        training: what is trained on what.
        output: file of the checkpoint; must not exist.
        config: of registration (voxel size and device of the method) and of training.
        report: called after each step.

    Raises:
        InputError: the output exists, was begun with other settings, or there are no pairs.
        MethodError: the method cannot be trained, or lacks its device.
        FormatError: a file cannot be read or written.
        RunError: training failed.
    """
    if output.exists():
        raise InputError(f"{output} is there already: choose another name, or remove it.")
    settings = config.training
    learned, validated = training_pairs(
        training.dataset, training.split, training.same_stage_only, settings.min_overlap
    )
    torch.set_num_threads(settings.threads)  # besides those that prepare pairs
    torch.manual_seed(training.seed)
    section = getattr(config.registration, training.method, None)
    device = chosen_device(getattr(section, "device", "auto"))
    trainee = new_trainee(training.method, config.registration, device)
    sources = [
        ExampleSource(training.dataset, pairs, settings, (kind, training.seed))
        for kind, pairs in ((_LEARNED, learned), (_VALIDATED, validated))
    ]
    count = min(settings.validation_pairs, len(validated))
    trainer = Trainer(trainee, sources[0], (sources[1], count), settings)
    record = _record(training, config, len(learned))
    partial = output.with_name(f"{output.name}.partial")
    if partial.exists():
        trainer.load(_begun(partial, record))
    else:
        _write(partial, trainer.state(), record)  # a place that cannot be written fails at once
    for each in trainer.steps():
        if each.validation is not None:
            _write(partial, trainer.state(), record)
        report(each)
    _write(output, {"state_dict": trainer.state()["state_dict"]}, record)
    partial.unlink()
    return record


def _record(training: Training, config: NssConfig, pairs: int) -> TrainingRecord:
    return TrainingRecord(
        training.method,
        getattr(config.registration, training.method).voxel_size,
        file_digest(training.dataset.path / POSES_NAME),
        sets_digest(training.dataset),
        training.split.value,
        training.same_stage_only,
        pairs,
        training.seed,
        config.training.model_dump(mode="json"),
        __version__,
    )


def _begun(path: Path, record: TrainingRecord) -> dict[str, Any]:
    """The state of a run that was cut short.

    Raises:
        FormatError: it cannot be read.
        InputError: it is of a run with other settings.
    """
    try:
        content: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
        before = TrainingRecord.from_json(content.get(RECORD_KEY))
    except Exception as error:
        raise FormatError(
            f"{path} cannot be read ({error}): remove it, and training begins anew."
        ) from error
    difference = "it tells nothing of itself" if before is None else record.difference(before)
    if difference:
        raise InputError(
            f"{path} was begun in another way ({difference}): choose another output, or remove it."
        )
    return content


def _write(path: Path, content: dict[str, Any], record: TrainingRecord) -> None:
    stream = io.BytesIO()
    torch.save(content | {RECORD_KEY: record.to_json()}, stream)
    write_file(path, stream.getvalue())
