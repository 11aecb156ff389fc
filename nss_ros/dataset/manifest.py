"""What a dataset folder says of itself: every setting, seed, version and source.

It holds no time of day and no host, so the same settings give the same bytes.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, ValidationError

from nss_ros import __version__
from nss_ros.config import Section
from nss_ros.errors import FormatError
from nss_ros.files import write_file
from nss_ros.versions import git_revision, package_versions

MANIFEST_NAME = "manifest.json"

# Those that points and images pass through.
_PACKAGES = ("numpy", "open3d", "open3d-cpu", "pillow", "scipy", "trimesh", "ifcopenshell")


class StageRecord(Section):
    """One stage of an area."""

    name: str = Field("", description="What the stage is, for people")
    fragments: int | None = Field(None, description="Number of fragments; null until complete")


class AreaRecord(Section):
    """One area of the dataset."""

    complete: bool = Field(False, description="All its fragments are there")
    stages: list[StageRecord] = Field([], description="In order; the first is stage 1")
    source: dict[str, Any] = Field({}, description="What the site was made from")


class Manifest(Section):
    """The content of `manifest.json`."""

    nss_dataset: Literal[1] = Field(1, description="Version of the layout of the folder")
    complete: bool = Field(False, description="All fragments of all areas are there")
    gravity_aligned: bool = Field(True, description="z points up in every fragment")
    seed: int = Field(description="Seed of everything random")
    simulation: dict[str, Any] = Field(description="All settings of the simulation")
    sites: dict[str, Any] = Field({}, description="The site file")
    labels: bool = Field(True, description="Points carry `element` and `change`")
    areas: dict[str, AreaRecord] = Field({}, description="By name, in the order they are made")
    versions: dict[str, str] = Field({}, description="Of what made it")
    steps: dict[str, dict[str, Any]] = Field(
        {}, description="Seed and settings of what was added: pairs, graphs"
    )

    def fragment_count(self) -> int:
        """Number of fragments of the complete stages."""
        return sum(s.fragments or 0 for area in self.areas.values() for s in area.stages)


def current_versions() -> dict[str, str]:
    """Versions of everything that the bytes of a dataset depend on."""
    ours = {"nss_ros": __version__, "git_revision": git_revision()}
    return ours | package_versions(_PACKAGES)


def read_manifest(folder: Path) -> Manifest:
    """The manifest of a dataset folder.

    Raises:
        FormatError: there is none, or it is not valid.
    """
    path = folder / MANIFEST_NAME
    try:
        return Manifest.model_validate_json(path.read_bytes())
    except OSError as error:
        raise FormatError(
            f"{folder} is not a dataset: it has no readable {MANIFEST_NAME}; make one with "
            "'nss simulate'."
        ) from error
    except ValidationError as error:
        first = error.errors()[0]
        name = ".".join(str(part) for part in first["loc"]) or "its content"
        raise FormatError(
            f"{path} is not the manifest of a dataset of this version of nss_ros: {name}: "
            f"{first['msg']}."
        ) from error


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Write the manifest of a dataset folder, whole or not at all.

    Raises:
        FormatError: the file cannot be written.
    """
    write_json(folder / MANIFEST_NAME, manifest.model_dump(mode="json"))


def write_json(path: Path, content: Any) -> None:
    """Write JSON for people and programs, the same bytes for the same content.

    Raises:
        FormatError: the file cannot be written.
    """
    write_file(path, (json.dumps(content, indent=1) + "\n").encode())
