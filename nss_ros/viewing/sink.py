"""Where a view goes: a viewer on this machine, one elsewhere, or a file."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from nss_ros.errors import FormatError, InputError
from nss_ros.listening import knock

_APPLICATION = "nss_ros"


def rerun() -> Any:
    """The package of the Rerun viewer.

    Raises:
        InputError: it is not installed.
    """
    try:
        import rerun as module
    except ImportError as error:
        raise InputError(
            "This command needs the Rerun viewer: pip install 'rerun-sdk', or look at the log in "
            "Foxglove with config/nss.foxglove.json."
        ) from error
    return module


@contextmanager
def recording(name: str, save: Path | None = None, connect: str = "") -> Iterator[Any]:
    """A Rerun recording that is written to a file, sent to a viewer, or shown in a new one.

    Args:
        name: of the recording, for people.
        save: file to write; what was there is replaced at the end.
        connect: URL of a viewer, for example rerun+http://desk:9876/proxy.

    Yields:
        The `rerun.RecordingStream`.

    Raises:
        InputError: Rerun is not installed, both a file and a viewer are given, or no viewer
            listens there.
        FormatError: the file cannot be written.
    """
    if save is not None and connect:
        raise InputError("Give either --save or --connect: a view goes to one place.")
    module = rerun()
    stream = module.RecordingStream(_APPLICATION)
    stream.send_recording_name(name)
    if save is not None:
        with _replaced(save) as temporary:
            stream.save(temporary)
            yield stream
            stream.flush()
            stream.disconnect()
        return
    if connect:
        _connect(stream, connect)
    else:
        _spawn(stream)
    try:
        yield stream
    finally:
        stream.flush(timeout_sec=60.0)
        stream.disconnect()


def _connect(stream: Any, url: str) -> None:
    try:
        knock(url)
        stream.connect_grpc(url)
    except (OSError, ValueError, RuntimeError) as error:
        raise InputError(
            f"No Rerun viewer listens at {url}: start 'rerun' there, and give the URL that it "
            "prints, for example rerun+http://127.0.0.1:9876/proxy."
        ) from error


def _spawn(stream: Any) -> None:
    try:
        stream.spawn()
    except (OSError, RuntimeError) as error:
        raise InputError(
            f"The Rerun viewer does not start here ({error}): write a file with --save, or "
            "--connect to a viewer elsewhere."
        ) from error


@contextmanager
def _replaced(path: Path) -> Iterator[Path]:
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with temporary.open("wb"):
            pass
    except OSError as error:
        raise FormatError(f"Cannot write {path}: {error.strerror}.") from error
    try:
        yield temporary
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
