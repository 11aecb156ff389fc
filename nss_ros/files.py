"""Writing files whole or not at all, and telling whether one is the same."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

from nss_ros.errors import FormatError, InputError


def write_file(path: Path, data: bytes) -> None:
    """Write a file; what was there before is replaced at the end, or kept if that fails.

    Raises:
        FormatError: the file cannot be written.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        if path.exists() and not path.is_file():  # a device or pipe: nothing to keep
            path.write_bytes(data)
            return
        temporary.write_bytes(data)
        temporary.replace(path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise FormatError(f"Cannot write {path}: {error.strerror}.") from error


def file_digest(path: Path) -> str:
    """SHA-256 of a file, its first 16 digits.

    Raises:
        InputError: it cannot be read.
    """
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()[:16]
    except OSError as error:
        raise InputError(f"Cannot read {path}: {error.strerror}.") from error
