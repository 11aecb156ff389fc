"""Test data is never training data: methods are not tried on what their weights learned from."""

from __future__ import annotations

from collections.abc import Sequence

from nss_ros.batch.source import BatchSplit, Source
from nss_ros.dataset.folder import POSES_NAME
from nss_ros.errors import InputError
from nss_ros.registration.learned.training_record import TrainingRecord
from nss_ros.registration.method import Method


def learned_from(
    name: str, method: Method, source: Source, splits: Sequence[BatchSplit]
) -> TrainingRecord | None:
    """What the weights of a method were trained on, if they tell.

    Args:
        name: of the method.
        method: loaded.
        source: whose pairs are registered.
        splits: whose test pairs, or all.

    Raises:
        InputError: pairs that are registered may be among those that it learned from.
    """
    record = getattr(method, "training", None)
    if not isinstance(record, TrainingRecord):
        return None
    if source.fingerprint().get(POSES_NAME) == record.poses:
        learned = f"Method '{name}' has learned from the split '{record.split}' of {source.path}"
        if source.sets() != record.sets:
            raise InputError(
                f"{learned}, whose splits were made anew since, so test pairs may be among those "
                "that it has learned: train again, or give other weights."
            )
        for split in splits:
            if split.value != record.split:
                raise InputError(
                    f"{learned}, so pairs of the split '{split}' may be among those that it has "
                    f"learned: give --split {record.split}, or other weights."
                )
    return record
