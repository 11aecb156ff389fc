"""16-bit greyscale PNG files: depth panoramas."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from nss_ros.errors import FormatError
from nss_ros.files import write_file

# Higher levels save a few per cent and take several times as long.
_COMPRESSION = 3


def write_depth_image(path: Path, image: NDArray[np.uint16]) -> None:
    """Write a (h, w) uint16 image as PNG.

    Raises:
        FormatError: the file cannot be written.
    """
    buffer = BytesIO()
    Image.fromarray(np.ascontiguousarray(image, dtype=np.uint16)).save(
        buffer, "PNG", compress_level=_COMPRESSION
    )
    write_file(path, buffer.getvalue())


def read_depth_image(path: Path) -> NDArray[np.uint16]:
    """A (h, w) uint16 image from a 16-bit greyscale PNG.

    Raises:
        FormatError: the file cannot be read, or is not such an image.
    """
    try:
        with Image.open(path) as image:
            mode, pixels = image.mode, np.asarray(image)
    except (UnidentifiedImageError, SyntaxError) as error:
        raise FormatError(f"{path} is not a PNG image.") from error
    except (OSError, ValueError) as error:
        raise FormatError(f"Cannot read the panorama {path}: {error}.") from error
    if pixels.ndim != 2 or not (mode.startswith("I;16") or mode == "I"):
        raise FormatError(
            f"{path} is not a depth panorama: expected one channel of 16 bits, not mode '{mode}'."
        )
    return np.asarray(pixels, dtype=np.uint16)
