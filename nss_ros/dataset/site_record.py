"""`sites/<area>.json`: what stood where and when, without its geometry."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationError

from nss_ros.config import Section
from nss_ros.dataset.manifest import write_json
from nss_ros.errors import FormatError
from nss_ros.simulation.site import Site


class ElementRecord(Section):
    """One element of a site."""

    index: int = Field(description="The `element` of the points on it")
    kind: str = Field(description="What it is")
    name: str = Field(description="Which one it is; may be empty")
    material: str = Field(description="matt, dark, metal or glass")
    stages: list[int] = Field(description="Stages at which it is there, from 1")


class SiteRecord(Section):
    """One area: its stages, its floor and its elements."""

    area: str = Field(description="Name of the area in fragment ids")
    stages: int = Field(ge=1, description="Number of stages")
    stage_names: list[str] = Field(description="One per stage, or none")
    extent: tuple[float, float, float, float] = Field(
        description="x0, y0, x1, y1 in which tripods may stand, metres, map frame"
    )
    floor_height: float = Field(description="z of the floor, metres, map frame")
    elements: list[ElementRecord] = Field(description="By their index")

    def present(self, stage: int) -> NDArray[np.bool_]:
        """Which elements are there at a stage, (elements,)."""
        return np.array([stage in element.stages for element in self.elements], dtype=bool)


def site_record(site: Site) -> SiteRecord:
    """What a dataset keeps of a site."""
    return SiteRecord(
        area=site.area,
        stages=site.stages,
        stage_names=list(site.stage_names),
        extent=(site.extent.x0, site.extent.y0, site.extent.x1, site.extent.y1),
        floor_height=site.floor_height,
        elements=[
            ElementRecord(
                index=index,
                kind=element.kind,
                name=element.name,
                material=element.material.name.lower(),
                stages=sorted(element.stages),
            )
            for index, element in enumerate(site.elements)
        ],
    )


def write_site(path: Path, record: SiteRecord) -> None:
    """Write `sites/<area>.json`.

    Raises:
        FormatError: the file cannot be written.
    """
    write_json(path, record.model_dump(mode="json"))


def read_site(path: Path) -> SiteRecord:
    """Read `sites/<area>.json`.

    Raises:
        FormatError: the file cannot be read or is not valid.
    """
    try:
        return SiteRecord.model_validate_json(path.read_bytes())
    except OSError as error:
        raise FormatError(f"Cannot read the site {path}: {error.strerror}.") from error
    except ValidationError as error:
        raise FormatError(
            f"{path} does not describe a site: {error.errors()[0]['msg']}; make the dataset again."
        ) from error
