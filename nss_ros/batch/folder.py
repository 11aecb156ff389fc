"""The folder of a benchmark's results.

benchmark.json            the settings that all results share
journal/                  results as they came, see `journal`
logs/<split>-<method>-<synchronizer>/
                          logs as the ROS graph records them, for 'nss score'
fragments/                the point clouds that the logs name, as a bag
work/                     features; gone when all is done
"""

from __future__ import annotations

import fcntl
import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from nss_ros.errors import FormatError, InputError, RunError
from nss_ros.files import write_file

SETTINGS_NAME = "benchmark.json"
_MADE_ELSEWHERE = "choose another folder with -o"


class ResultsFolder:
    """A folder that one benchmark at a time fills; its settings never change.

    Args:
        path: made if it is not there.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.journal = path / "journal"
        self.logs = path / "logs"
        self.fragments = path / "fragments"
        self.work = path / "work"
        self.begun = self.work / "begun"

    @contextmanager
    def opened(
        self, settings: dict[str, Any], versions: dict[str, str]
    ) -> Iterator[dict[str, str]]:
        """Begin, or go on with a benchmark of the same settings.

        Plug-ins are the settings under "plugins": those that are new are added.

        Args:
            settings: all that the results depend on; what JSON can hold.
            versions: of what runs, kept from the first session.

        Yields:
            The versions of the first session.

        Raises:
            InputError: the folder holds something else, or results of other settings.
            RunError: another benchmark is filling it.
        """
        if self.path.exists() and not self.path.is_dir():
            raise InputError(f"{self.path} is not a folder: {_MADE_ELSEWHERE}.")
        record = self.path / SETTINGS_NAME
        if self.path.exists() and not record.exists() and self._foreign():
            raise InputError(
                f"{self.path} holds files that are not of 'nss benchmark': {_MADE_ELSEWHERE}."
            )
        self.path.mkdir(parents=True, exist_ok=True)
        with (self.path / ".lock").open("w") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                raise RunError(
                    f"Another 'nss benchmark' is writing to {self.path}: wait for it, or choose "
                    "another folder."
                ) from error
            yield self._agreed(record, settings, versions)

    def finish(self) -> None:
        """Remove what only helped to get here."""
        shutil.rmtree(self.work, ignore_errors=True)

    def _foreign(self) -> bool:
        return any(each.name != ".lock" for each in self.path.iterdir())

    def _agreed(
        self, record: Path, settings: dict[str, Any], versions: dict[str, str]
    ) -> dict[str, str]:
        content = {"settings": json.loads(json.dumps(settings)), "versions": versions}
        if record.exists():
            before = _read(record)
            for name, (old, new) in _differences(before["settings"], content["settings"]):
                raise InputError(
                    f"{self.path} was made with other settings ({name} is {old!r} there and "
                    f"{new!r} here): {_MADE_ELSEWHERE}, or use the same settings."
                )
            content["settings"]["plugins"] |= before["settings"]["plugins"]
            content["versions"] = before["versions"]
        write_file(record, (json.dumps(content, indent=1) + "\n").encode())
        return dict(content["versions"])


def _read(record: Path) -> dict[str, Any]:
    try:
        content = json.loads(record.read_bytes())
        assert isinstance(content["settings"]["plugins"], dict)
        assert isinstance(content["versions"], dict)
    except (OSError, ValueError, KeyError, TypeError, AssertionError) as error:
        raise FormatError(
            f"{record} is not readable as settings of 'nss benchmark': {_MADE_ELSEWHERE}."
        ) from error
    return dict(content)


def _differences(old: Any, new: Any, name: str = "") -> Iterator[tuple[str, tuple[Any, Any]]]:
    """Names and both values; a plug-in that only one has makes no difference."""
    if not (isinstance(old, dict) and isinstance(new, dict)):
        if old != new:
            yield name, (old, new)
        return
    either = old.keys() & new.keys() if name == "plugins" else old.keys() | new.keys()
    for key in sorted(either):
        yield from _differences(old.get(key), new.get(key), f"{name}.{key}".lstrip("."))
