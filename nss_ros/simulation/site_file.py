"""Site files: which areas there are, and what each is built from.

    areas:
      "1":
        procedural: {use: office, width: 38, depth: 16, stages: 3}
      "2":
        meshes: {stages: [shell.ply, finished.obj]}
      "3":
        ifc: {files: [structure.ifc, walls.ifc], storey: "Level 2"}
    viewpoints: {min_region: 0.1}

An area is one building floor; its name goes into the fragment ids. Relative paths are relative to
the site file. Viewpoints are settings that suit these sites; those that a user sets win over them.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from glob import escape
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Self

import yaml
from pydantic import Field, StringConstraints, model_validator

from nss_ros.config import SimulationConfig, SiteConfig, ViewpointConfig, validated
from nss_ros.config.section import Section
from nss_ros.errors import InputError
from nss_ros.simulation.ifc_plan import IfcArea
from nss_ros.simulation.ifc_site import build_ifc_site, walled_storeys
from nss_ros.simulation.mesh_site import MESH_ENDINGS, MeshArea, build_mesh_site
from nss_ros.simulation.procedural.floor import build_floor
from nss_ros.simulation.site import Site

AreaName = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9.-]+$")]
Report = Callable[[str, int, int], None]
"""Progress of building: what, how much of it is done, of how much."""

_IFC_ENDINGS = frozenset((".ifc", ".ifczip"))
_BUILT_IN = files("nss_ros.simulation") / "sites"


class AreaEntry(Section):
    """What one area is built from: exactly one of the three."""

    procedural: SiteConfig | None = Field(None, description="A floor drawn at random")
    meshes: MeshArea | None = Field(None, description="One mesh per stage")
    ifc: IfcArea | None = Field(None, description="A storey of a building model")

    @model_validator(mode="after")
    def _one(self) -> Self:
        given = [name for name in type(self).model_fields if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError("an area needs exactly one of 'procedural', 'meshes' and 'ifc'")
        return self


class SiteFile(Section):
    """The content of a site file."""

    areas: dict[AreaName, AreaEntry] = Field(min_length=1, description="Areas by name")
    viewpoints: ViewpointConfig | None = Field(
        None, description="Where tripods are put, unless the settings of a run say otherwise"
    )


def built_in_sites() -> list[str]:
    """Names of the site files that come with nss_ros."""
    return sorted(Path(str(each)).stem for each in _BUILT_IN.iterdir() if _is_yaml(str(each)))


def site_file_of(
    arguments: Sequence[str],
    area: str = "1",
    storeys: str | None = None,
    report: Report | None = None,
) -> tuple[SiteFile, Path]:
    """The site file that a user means, and the folder that its paths are relative to.

    Args:
        arguments: the name of a built-in site file; the path of one; IFC files of one building;
            or one mesh per stage.
        area: name of the area where no site file names it.
        storeys: shell pattern of the storeys of IFC files that become an area each, numbered
            from the lowest; None: one area, the storey of most elements.
        report: progress of reading the files for their storeys.

    Raises:
        InputError: nothing of that is there, or storeys are asked of what is no IFC file.
        ConfigError: the site file is not valid.
    """
    models = {Path(argument).suffix.lower() for argument in arguments} <= _IFC_ENDINGS
    if storeys is not None and not models:
        raise InputError(
            "--storeys is for IFC files that are given by name; a site file says itself which "
            "storey each area is."
        )
    if not arguments:
        raise InputError(f"Name a site: {', '.join(built_in_sites())}, a site file or models.")
    if len(arguments) == 1 and arguments[0] in built_in_sites():
        text = (_BUILT_IN / f"{arguments[0]}.yaml").read_text()
        return validated(SiteFile, yaml.safe_load(text), arguments[0]), Path()
    for argument in arguments:
        if not Path(argument).is_file():
            raise InputError(
                f"There is no site '{argument}': give a file (site YAML, IFC, meshes), or one of "
                f"{', '.join(built_in_sites())}."
            )
    endings = {Path(argument).suffix.lower() for argument in arguments}
    paths = [str(Path(argument).resolve()) for argument in arguments]
    if endings <= {".yaml", ".yml"} and len(arguments) == 1:
        return _read(Path(arguments[0])), Path(arguments[0]).resolve().parent
    if models:
        # Brackets and stars in a name are no pattern.
        model = {"files": [escape(path) for path in paths], "clutter": 1.0}
        if storeys is not None:
            names = walled_storeys([Path(path) for path in paths], storeys, report)
            entries = {
                str(number): {"ifc": {**model, "storey": escape(name)}}
                for number, name in enumerate(names, start=1)
            }
            return validated(SiteFile, {"areas": entries}, "the command line"), Path()
        entry: dict[str, Any] = {"ifc": model}
    elif endings <= MESH_ENDINGS:
        entry = {"meshes": {"stages": paths}}
    else:
        raise InputError(
            f"Cannot tell what {' '.join(arguments)} is: give one site file (.yaml), IFC files of "
            "one building, or one mesh per stage."
        )
    return validated(SiteFile, {"areas": {area: entry}}, "the command line"), Path()


def settings_for(site_file: SiteFile, config: SimulationConfig) -> SimulationConfig:
    """Settings of a run, those of the site file where the run sets nothing itself.

    Args:
        site_file: the areas, with settings of their own or without.
        config: of the run, as it was read: what was set there is told from defaults.

    Raises:
        ConfigError: the two do not go together.
    """
    if site_file.viewpoints is None:
        return config
    given: dict[str, Any] = {}
    for viewpoints in (site_file.viewpoints, config.viewpoints):
        given |= viewpoints.model_dump(include=viewpoints.model_fields_set)
    merged = validated(ViewpointConfig, given, "the site file and the settings of the run")
    return config.model_copy(update={"viewpoints": merged})


def areas(
    site_file: SiteFile, folder: Path, seed: int, report: Report | None = None
) -> list[tuple[str, Callable[[], Site]]]:
    """Name of each area, and what builds it, so that one can be built at a time.

    Args:
        site_file: the areas.
        folder: that relative paths are relative to.
        seed: of what is random; each area draws from a stream of its own.
        report: progress.
    """
    return [
        (name, lambda name=name, entry=entry: _build(name, entry, folder, seed, report))  # type: ignore[misc]
        for name, entry in site_file.areas.items()
    ]


def _build(name: str, entry: AreaEntry, folder: Path, seed: int, report: Report | None) -> Site:
    own_seed = zlib.crc32(f"{seed}/{name}".encode())
    if entry.procedural is not None:
        return build_floor(name, entry.procedural, own_seed)
    if entry.meshes is not None:
        return build_mesh_site(name, entry.meshes, folder, own_seed)
    assert entry.ifc is not None  # exactly one is there
    return build_ifc_site(name, entry.ifc, folder, report, own_seed)


def _read(path: Path) -> SiteFile:
    try:
        data = yaml.safe_load(path.read_text())
    except (OSError, UnicodeDecodeError, yaml.YAMLError, RecursionError) as error:
        reason = " ".join(str(error).split())
        raise InputError(f"The site file {path} is not valid YAML: {reason}.") from error
    return validated(SiteFile, data, str(path))


def _is_yaml(name: str) -> bool:
    return name.endswith(".yaml")
