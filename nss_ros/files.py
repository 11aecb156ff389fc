"""Writing files whole or not at all."""

from __future__ import annotations

import os
from pathlib import Path

from nss_ros.errors import FormatError


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
