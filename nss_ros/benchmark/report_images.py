"""Figures as pictures inside an HTML page."""

from __future__ import annotations

import io
from base64 import b64encode
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from nss_ros.dataset.figures import STYLE

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from PIL import Image as Pillow

_DPI = 120
_PALETTE = 64
_QUALITY = 88


@dataclass(frozen=True, slots=True)
class Image:
    """A picture as it lies in the page.

    Attributes:
        source: `data:` URL.
        width: pixels; known before it is decoded, so that the page does not jump.
        height: pixels.
    """

    source: str
    width: int
    height: int


def drawing(figure: Figure) -> Image:
    """A figure of lines and text: PNG of few colours."""
    from PIL import Image as Pillow

    small = _pixels(figure).quantize(_PALETTE, dither=Pillow.Dither.NONE)
    return _image(small, "png", optimize=True)


def photograph(figure: Figure) -> Image:
    """A figure full of points: WebP, a quarter of the size of a PNG."""
    return _image(_pixels(figure), "webp", quality=_QUALITY)


def _pixels(figure: Figure) -> Pillow.Image:
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from PIL import Image as Pillow

    with mpl.rc_context(STYLE):
        figure.set_dpi(_DPI)
        canvas: Any = FigureCanvasAgg(figure)  # which has no types
        canvas.draw()
        return Pillow.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")


def _image(picture: Pillow.Image, form: str, **options: Any) -> Image:
    stream = io.BytesIO()
    picture.save(stream, form, **options)
    text = b64encode(stream.getvalue()).decode("ascii")
    return Image(f"data:image/{form};base64,{text}", picture.width, picture.height)
