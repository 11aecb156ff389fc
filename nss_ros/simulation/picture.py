"""Pictures of a site: a stage cut open and seen from above, all stages, the view from a spot.

All are drawn without a display, and the same site gives the same pixels. Things are coloured by
what they are; things that were not there at the stage before can be tinted.
"""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nss_ros.errors import InputError
from nss_ros.files import write_file
from nss_ros.simulation.element import Element, Material
from nss_ros.simulation.rendering import Renderer
from nss_ros.simulation.site import Site

Image = NDArray[np.uint8]
"""(h, w, 3) uint8, red green blue."""

Array = NDArray[np.float64]

CUT_HEIGHT = 2.2
"""Above the floor, metres: below the ceilings, above what stands on the floor."""

NEW_COLOUR = (0.90, 0.45, 0.05)
"""Tint of what was not there at the stage before."""

_SAMPLES = 2  # per pixel along each side: one of each pattern of the renderer
_MARGIN = 0.4  # of a picture, metres
_SURROUNDINGS = 2.5  # what stands farther outside does not widen it, metres
_GAP = 16
_SKY, _GROUND = np.array([0.93, 0.96, 0.99]), np.array([0.75, 0.76, 0.76])
_OLD_COLOUR = np.array([0.80, 0.80, 0.78])

# The first that occurs in the name of a kind decides.
_COLOURS = (
    (r"glass|glaz|pane\b|curtain", (0.62, 0.80, 0.86)),
    (r"stair", (0.66, 0.67, 0.68)),
    (r"duct|diffuser|ventil", (0.42, 0.60, 0.72)),
    (r"sprinkler|pipe|flow|hydrant", (0.78, 0.36, 0.30)),
    (r"cable|tray|conduit|socket|electr", (0.45, 0.62, 0.45)),
    (r"stud|track|profile|frame|member|metal|hanger|rail", (0.56, 0.61, 0.68)),
    (r"door", (0.66, 0.48, 0.32)),
    (r"window", (0.62, 0.80, 0.86)),
    (r"insulation", (0.87, 0.74, 0.42)),
    (r"scaffold|ladder|lift|prop\b|props\b|shor|formwork", (0.88, 0.68, 0.20)),
    (r"pallet|board_stack|boards|plank|wood|timber|sawhorse|crate", (0.78, 0.62, 0.42)),
    (r"desk|chair|shelf|cabinet|table|furnish|sofa|bed|kitchen", (0.60, 0.47, 0.40)),
    (r"bin|bucket|carton|box|drum|tool|bag|rubble|rubbish|debris|barrow", (0.52, 0.55, 0.40)),
    (r"board|partition|plaster|drywall|ceiling|cover", (0.93, 0.90, 0.83)),
    (r"brick|mason|block", (0.74, 0.52, 0.44)),
    (r"slab|floor|screed", (0.78, 0.78, 0.77)),
    (r"column|beam|core|wall|facade|concrete|parapet|shaft", (0.66, 0.67, 0.68)),
)
_MATERIAL_COLOURS = {
    Material.MATT: (0.80, 0.77, 0.70),
    Material.DARK: (0.32, 0.32, 0.34),
    Material.METAL: (0.56, 0.61, 0.68),
    Material.GLASS: (0.62, 0.80, 0.86),
}


def stage_picture(
    site: Site,
    stage: int,
    width: int = 1000,
    mark_new: bool = False,
    azimuth: float = 65.0,
    elevation: float = 52.0,
    cut_height: float = CUT_HEIGHT,
) -> Image:
    """One stage, cut open below the ceilings and seen obliquely from above without perspective.

    Args:
        site: of any source.
        stage: from 1.
        width: pixels; the height follows from the site's extent, so that all stages match.
        mark_new: tint what was not there at the stage before, and grey all else.
        azimuth: heading of the look, degrees from x to y.
        elevation: of the eye above the horizon, degrees; 90 gives a plan.
        cut_height: above the floor, metres.

    Raises:
        InputError: there is no such stage, or no such picture.
    """
    if not 0 < elevation <= 90 or width < 1 or cut_height <= 0:
        raise InputError(
            "A picture needs an elevation of more than 0 and up to 90 degrees, and a positive "
            f"width and cut height, not {elevation} degrees, {width} pixels and {cut_height} m."
        )
    right, up, forward = camera_axes(azimuth, -elevation)
    low, high = _frame(site, right, up, cut_height)
    height = max(1, round(width * (high[1] - low[1]) / (high[0] - low[0])))
    across, down, patterns = _samples(width, height)
    u = low[0] + across * (high[0] - low[0])
    v = high[1] - down * (high[1] - low[1])
    origins = u[:, None] * right + v[:, None] * up - 1e3 * forward
    directions = np.broadcast_to(forward, origins.shape)
    renderer = _renderer(site, stage, mark_new, site.floor_height + cut_height)
    colours = renderer.shade(origins, directions, patterns, np.ones_like(origins))
    return _image(colours, width, height)


def stages_picture(site: Site, width: int = 1600, azimuth: float = 65.0) -> Image:
    """All stages side by side, what is new at each tinted from the second on.

    Args:
        site: of any source.
        width: of the whole picture, pixels.
        azimuth: heading of the look, degrees from x to y.
    """
    each = (width - _GAP * (site.stages - 1)) // site.stages
    stages = range(1, site.stages + 1)
    titles = [stage_title(site, stage) for stage in stages]
    return side_by_side(
        [stage_picture(site, stage, each, stage > 1, azimuth) for stage in stages],
        [titles[0], *(f"{title} (new: orange)" for title in titles[1:])],
    )


def interior_picture(
    site: Site,
    stage: int,
    eye: tuple[float, float, float],
    heading: float,
    size: tuple[int, int] = (800, 500),
    field_of_view: float = 85.0,
    mark_new: bool = False,
) -> Image:
    """The view from a place inside, level, in perspective.

    Args:
        site: of any source.
        stage: from 1.
        eye: x, y, z in the map frame, metres.
        heading: of the look, degrees from x to y.
        size: width and height, pixels.
        field_of_view: horizontal, degrees.
        mark_new: tint what was not there at the stage before, and grey all else.

    Raises:
        InputError: there is no such stage, or no such picture.
    """
    width, height = size
    if not 0 < field_of_view < 180 or min(size) < 1:
        raise InputError(
            "A picture needs a field of view of more than 0 and less than 180 degrees, and a "
            f"positive size, not {field_of_view} degrees and {width} x {height} pixels."
        )
    right, up, forward = camera_axes(heading, 0.0)
    half = np.tan(np.radians(field_of_view / 2))
    across, down, patterns = _samples(width, height)
    x, y = (2 * across - 1) * half, (1 - 2 * down) * half * height / width
    directions = forward + x[:, None] * right + y[:, None] * up
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origins = np.broadcast_to(np.asarray(eye, dtype=np.float64), directions.shape)
    sky = np.where(directions[:, 2:] > 0, _SKY, _GROUND)
    renderer = _renderer(site, stage, mark_new)
    colours = renderer.shade(origins, directions, patterns, sky, sun=False)
    return _image(colours, width, height)


def interiors_picture(
    site: Site, eye: tuple[float, float, float], heading: float, width: int = 1600
) -> Image:
    """The view from one place at all stages, side by side.

    Args:
        site: of any source.
        eye: x, y, z in the map frame, metres.
        heading: of the look, degrees from x to y.
        width: of the whole picture, pixels.
    """
    each = (width - _GAP * (site.stages - 1)) // site.stages
    stages = range(1, site.stages + 1)
    return side_by_side(
        [interior_picture(site, s, eye, heading, (each, round(each * 0.72))) for s in stages],
        [stage_title(site, stage) for stage in stages],
    )


def stage_title(site: Site, stage: int) -> str:
    """Number and, where it has one, name of a stage."""
    return f"Stage {stage}: {site.stage_names[stage - 1]}" if site.stage_names else f"Stage {stage}"


def side_by_side(images: Sequence[Image], titles: Sequence[str]) -> Image:
    """Pictures in a row with a title above each, on white."""
    from PIL import Image as Pillow
    from PIL import ImageDraw, ImageFont

    size = max(11, min(22, min(image.shape[1] for image in images) // 24))
    top = 2 * size
    width = sum(image.shape[1] for image in images) + _GAP * (len(images) - 1)
    canvas = Pillow.new("RGB", (width, top + max(image.shape[0] for image in images)), "white")
    draw = ImageDraw.Draw(canvas)
    font = ImageFont.load_default(size)
    left = 0
    for image, title in zip(images, titles, strict=True):
        canvas.paste(Pillow.fromarray(image), (left, top))
        draw.text((left + image.shape[1] / 2, top / 2), title, (30, 30, 30), font, anchor="mm")
        left += image.shape[1] + _GAP
    return np.asarray(canvas)


def write_png(path: Path, image: Image, colours: int | None = None) -> None:
    """Write a picture as PNG.

    Args:
        path: file.
        image: the picture.
        colours: at most so many (2 to 256), for a file less than half in size; None keeps all.

    Raises:
        FormatError: the file cannot be written.
    """
    from PIL import Image as Pillow

    picture = Pillow.fromarray(image)
    if colours is not None:
        picture = picture.quantize(colours, kmeans=2, dither=Pillow.Dither.NONE)
    stream = io.BytesIO()
    picture.save(stream, "png", optimize=True)
    write_file(path, stream.getvalue())


def kind_colour(element: Element) -> tuple[float, float, float]:
    """Red, green and blue (0..1) of what an element is, by its kind or else its material."""
    kind = element.kind.lower()
    for pattern, colour in _COLOURS:
        if re.search(pattern, kind):
            return colour
    return _MATERIAL_COLOURS[element.material]


def _renderer(site: Site, stage: int, mark_new: bool, cut: float = float("inf")) -> Renderer:
    there = site.stage_mesh(stage)
    colours = np.array([kind_colour(element) for element in site.elements]).reshape(-1, 3)
    if mark_new:
        new = np.array([stage - 1 not in element.stages for element in site.elements], dtype=bool)
        colours = np.where(new[:, None], NEW_COLOUR, 0.4 * colours + 0.6 * _OLD_COLOUR)
    return Renderer(there.mesh, colours[there.elements], cut)


def camera_axes(azimuth: float, pitch: float) -> tuple[Array, Array, Array]:
    """Right, up and forward of a camera without roll; angles in degrees, pitch up positive."""
    yaw, pitch = np.radians(azimuth), np.radians(pitch)
    forward = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)])
    right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
    return right, np.cross(right, forward), forward


def _frame(site: Site, right: Array, up: Array, height: float) -> tuple[Array, Array]:
    """Lower left and upper right in the picture plane of all that is near the floor, metres."""
    extent, z = site.extent, site.floor_height
    low, high = np.array((extent.x0, extent.y0, z)), np.array((extent.x1, extent.y1, z + height))
    around = np.array((_SURROUNDINGS, _SURROUNDINGS, 0.5))
    around_top = around * (1, 1, 0)
    vertices = np.concatenate(
        [np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(3, -1).T]
        + [element.mesh.vertices for element in site.elements if len(element.mesh.vertices)]
    )
    plane = np.clip(vertices, low - around, high + around_top) @ np.stack((right, up), axis=1)
    return plane.min(axis=0) - _MARGIN, plane.max(axis=0) + _MARGIN


def _samples(width: int, height: int) -> tuple[Array, Array, NDArray[np.intp]]:
    """Places of all samples from the left and from the top (0..1) and patterns, row by row."""
    rows, columns = np.indices((height * _SAMPLES, width * _SAMPLES)).reshape(2, -1)
    across = (columns + 0.5) / (width * _SAMPLES)
    down = (rows + 0.5) / (height * _SAMPLES)
    return across, down, _SAMPLES * (rows % _SAMPLES) + columns % _SAMPLES


def _image(colours: Array, width: int, height: int) -> Image:
    """The mean of each pixel's samples, gamma-corrected."""
    samples = colours.reshape(height, _SAMPLES, width, _SAMPLES, 3)
    pixels = np.clip(samples.mean(axis=(1, 3)), 0.0, 1.0) ** (1 / 1.35)
    return np.asarray(np.rint(255 * pixels), dtype=np.uint8)
