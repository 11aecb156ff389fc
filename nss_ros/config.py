"""All settings, typed, with their defaults, limits and meaning.

This is the single definition: configuration files, `--set` options and ROS parameters are all
read into these models, so a name, a unit and a limit stand in one place. A ROS parameter has
the dotted name of the field inside its node's section, for example `icp.max_distance` on the
registration node is `registration.icp.max_distance` in a file.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Self, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from nss_ros.errors import ConfigError
from nss_ros.files import write_file

Positive = Annotated[float, Field(gt=0)]
Fraction = Annotated[float, Field(ge=0, le=1)]


class Section(BaseModel):
    """A group of settings: unknown names and wrong types are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


T = TypeVar("T", bound=Section)

# Dates that do not exist are a ValueError, deep nesting ends in a RecursionError.
_YAML_ERRORS = (yaml.YAMLError, ValueError, RecursionError)


def _in_order(section: T, *limits: tuple[str, str]) -> T:
    for low, high in limits:
        if getattr(section, low) > getattr(section, high):
            raise ValueError(f"{low} must not be more than {high}")
    return section


class PlayerConfig(Section):
    """How bags are replayed."""

    bags: list[str] = Field([], description="Bag directories, played one after the other")
    rate: float = Field(
        1.0, ge=0, description="Speed against recorded time; 0: as fast as possible"
    )
    start_offset: float = Field(
        0.0, ge=0, description="Seconds of bag time to skip (latched data is still published)"
    )
    loop: bool = Field(False, description="Start again at the end")
    start_paused: bool = Field(False, description="Wait for the resume service before playing")
    publish_clock: bool = Field(True, description="Publish bag time on /clock")
    pair_across_bags: bool = Field(
        True,
        description="With several bags: also ask for every pair of one area between different bags",
    )
    max_pending_pairs: int = Field(
        64, ge=0, description="Hold back when this many pairs await an answer; 0: never"
    )
    wait_for_subscribers: float = Field(
        10.0, ge=0, description="Longest wait for a first subscriber of fragments, seconds"
    )


class FpfhConfig(Section):
    """FPFH features (Rusu et al. 2009) and feature matching."""

    voxel_size: Positive = Field(
        0.1, description="Voxel size of the points that are described, metres"
    )
    normal_radius: Positive = Field(0.25, description="Neighbourhood of normals, metres")
    feature_radius: Positive = Field(0.6, description="Neighbourhood of the descriptor, metres")
    max_keypoints: int = Field(
        5000, gt=0, description="Described points kept for matching, those of the least flat places"
    )
    inlier_distance: Positive = Field(
        0.15, description="Correspondences closer than this agree, metres"
    )
    use_gravity: bool = Field(
        True,
        description="RANSAC of two levelled fragments looks for yaw and translation only",
    )
    hypotheses: int = Field(
        200, gt=0, description="RANSAC hypotheses that are compared before the best are refined"
    )
    ransac_iterations: int = Field(500_000, gt=0, description="Most RANSAC samples per pair")
    ransac_confidence: Fraction = Field(
        0.999, description="RANSAC stops at this probability of success"
    )
    fgr_iterations: int = Field(64, gt=0, description="Iterations of fast global registration")


class IcpConfig(Section):
    """Point-to-plane refinement."""

    max_distance: Positive = Field(
        0.1, description="Longest correspondence of the last level, metres; twice that at first"
    )
    iterations: int = Field(40, gt=0, description="Most iterations per level")
    max_points: int = Field(4000, gt=0, description="Source points used, evenly taken")


class RegistrationConfig(Section):
    """How pairs are registered."""

    method: str = Field(
        "fpfh_ransac", description="Registered name of the method; see 'nss methods'"
    )
    seed: int = Field(0, ge=0, description="Mixed with the hash of the pair into each pair's seed")
    voxel_size: Positive = Field(
        0.05, description="Fragments are voxelised to this size on arrival, metres"
    )
    min_points: int = Field(100, ge=3, description="Fewest voxelised points that a fragment needs")
    min_inlier_ratio: Fraction = Field(0.05, description="Least inlier ratio of an estimate")
    max_tilt: Positive = Field(3.0, description="Most tilt between two levelled fragments, degrees")
    overlap_distance: Positive = Field(
        0.2, description="Distance at which points count as overlapping (tau), metres"
    )
    fpfh: FpfhConfig = FpfhConfig()
    icp: IcpConfig = IcpConfig()


class RegistrationNodeConfig(RegistrationConfig):
    """Registration as a node: what is registered, by how many."""

    workers: int = Field(0, ge=0, le=256, description="Worker processes; 0: one per processor core")
    fragment_timeout: Positive = Field(
        15.0,
        description="A pair is answered 'unknown fragment' when no fragment has come for this long, seconds",
    )
    shard_index: int = Field(
        0, ge=0, description="This node's place among the nodes that share the pairs"
    )
    shard_count: int = Field(
        1, ge=1, description="Number of registration nodes that share the pairs"
    )
    memory_limit: int = Field(
        1024,
        gt=0,
        description="MiB of fragments and features kept in memory by each process; the rest waits on disk",
    )


class MultiwayConfig(Section):
    """How relative transforms become poses (Choi et al. 2015)."""

    synchronizer: str = Field(
        "choi", description="Registered name of the multi-way method; see 'nss methods'"
    )
    start: Literal["triangles", "confidence"] = Field(
        "triangles",
        description="Spanning tree of the initial poses: by triangle support, or by confidence as in the paper's set-up",
    )
    max_distance: Positive = Field(
        0.2, description="Correspondence distance that scales the line process, metres"
    )
    prune_threshold: Fraction = Field(
        0.25, description="Edges whose line process falls below this are rejected"
    )
    preference: Positive = Field(1.0, description="Preference for keeping edges; larger keeps more")
    min_confidence: Fraction = Field(
        0.0, description="Relative transforms below this confidence are rejected at once"
    )
    max_tilt: Positive = Field(
        3.0, description="Levelled edges tilted by more than this are rejected at once, degrees"
    )
    loop_translation: Positive = Field(
        0.4, description="A loop of edges closes if it misses by no more than this, metres"
    )
    loop_rotation: Positive = Field(6.0, description="... and by no more than this, degrees")
    bridge_confidence: Fraction = Field(
        0.5,
        description="An edge that no loop confirms needs this confidence to link two parts of the map",
    )


class PoseGraphConfig(MultiwayConfig):
    """The pose-graph node: map, frames and rates."""

    map_frame: str = Field(
        "map",
        min_length=1,
        description="Name of the map frame; component n > 0 gets <map_frame>_<n>",
    )
    map_voxel_size: Positive = Field(0.1, description="Voxel size of the published maps, metres")
    update_period: Positive = Field(2.0, description="Least time between optimisations, seconds")
    settle_time: Positive = Field(
        1.0, description="Quiet time after which the graph counts as settled, seconds"
    )


class RecorderConfig(Section):
    """What is logged, and how."""

    output: str = Field("", description="Directory of the log to write; must not exist")
    metadata_file: str = Field(
        "", description="JSON object of strings to store in the log as run metadata"
    )
    flush_period: Positive = Field(
        0.5, description="Longest time that data waits before it is on disk, seconds"
    )
    record_fragments: bool = Field(
        True,
        description="Log point clouds too, so that the log alone can be scored with point metrics",
    )
    record_maps: bool = Field(True, description="Log the maps and markers too")


class SiteConfig(Section):
    """The procedural construction floor."""

    stages: int = Field(3, ge=1, le=3, description="Number of stages: shell, rough-in, finishing")
    width: float = Field(16.0, ge=14, le=40, description="Clear size along x, metres")
    depth: float = Field(12.0, ge=11, le=30, description="Clear size along y, metres")
    height: float = Field(3.2, ge=3.0, le=4.5, description="Floor slab to ceiling slab, metres")


class ViewpointConfig(Section):
    """Where the tripod is put."""

    spots_per_stage: int = Field(8, ge=1, le=500, description="Most spots per stage")
    cell_size: Positive = Field(0.1, description="Cells of the occupancy map, metres")
    min_height: Positive = Field(0.5, description="Lowest obstacle in the occupancy map, metres")
    max_height: Positive = Field(2.0, description="Highest obstacle in the occupancy map, metres")
    min_clearance: Positive = Field(0.5, description="Least distance from obstacles, metres")
    passage: Positive = Field(
        0.25, description="Clearance that a person needs to get through, metres"
    )
    min_spacing: Positive = Field(1.5, description="Least distance between spots, metres")
    usual_spacing: Positive = Field(
        2.5, description="Usual longest distance to an earlier spot in sight, metres"
    )
    max_spacing: Positive = Field(
        4.0, description="... and when there is no place left nearer than that, metres"
    )

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        return _in_order(self, ("min_height", "max_height"))


class RigConfig(Section):
    """Three depth sensors on a turning tripod head (Matterport with PrimeSense sensors)."""

    horizontal_fov: float = Field(58.0, gt=0, lt=120, description="Field of view, degrees")
    vertical_fov: float = Field(45.0, gt=0, lt=120, description="Field of view, degrees")
    image_width: int = Field(160, ge=8, le=1280, description="Pixels of a depth image")
    image_height: int = Field(120, ge=8, le=1024, description="Pixels of a depth image")
    min_range: Positive = Field(0.4, description="Nearer surfaces give no return, metres")
    max_range: Positive = Field(4.5, description="Farther surfaces give no return, metres")
    axial_noise: float = Field(
        0.0015, ge=0, description="Depth noise at 1 m, growing with its square, metres sigma"
    )
    disparity_step: float = Field(
        1 / 350, ge=0, description="Depth quantisation at 1 m, growing with its square, metres"
    )
    lateral_noise: float = Field(0.05, ge=0, description="Jitter of the rays, degrees sigma")
    grazing_start: float = Field(
        70.0, ge=0, lt=90, description="Incidence from which returns get lost, degrees"
    )
    grazing_end: float = Field(
        85.0, gt=0, le=90, description="Incidence from which there are none, degrees"
    )
    dropout: Fraction = Field(0.02, description="Share of returns lost anywhere")
    min_tripod_height: Positive = Field(1.5, description="Sensor above the floor, metres")
    max_tripod_height: Positive = Field(1.75, description="Sensor above the floor, metres")
    tilt: float = Field(0.5, ge=0, description="Sigma of the tripod's tilt per axis, degrees")

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        return _in_order(
            self,
            ("min_range", "max_range"),
            ("grazing_start", "grazing_end"),
            ("min_tripod_height", "max_tripod_height"),
        )


class SimulationConfig(Section):
    """A simulated site and its scans."""

    seed: int = Field(0, ge=0, description="Same seed and settings, same points")
    area: str = Field("1", pattern=r"^[A-Za-z0-9.-]+$", description="Area of the fragment ids")
    voxel_size: Positive = Field(
        0.075, description="Voxel size of the fragments, as in the NSS release, metres"
    )
    overlap_distance: Positive = Field(
        0.2, description="Distance at which points count as overlapping (tau), metres"
    )
    min_overlap: Fraction = Field(0.1, description="Least overlap ratio of a pair")
    site: SiteConfig = SiteConfig()
    viewpoints: ViewpointConfig = ViewpointConfig()
    rig: RigConfig = RigConfig()


class NssConfig(Section):
    """Everything: one section per node, and the simulator's."""

    player: PlayerConfig = PlayerConfig()
    registration: RegistrationNodeConfig = RegistrationNodeConfig()
    pose_graph: PoseGraphConfig = PoseGraphConfig()
    recorder: RecorderConfig = RecorderConfig()
    simulation: SimulationConfig = SimulationConfig()


def load_config(
    path: Path | None = None,
    overrides: Sequence[str] = (),
    defaults: Sequence[str] = (),
) -> NssConfig:
    """Settings from a YAML file and `section.name=value` overrides, defaults for the rest.

    Args:
        path: YAML file with sections.
        overrides: win over the file.
        defaults: like overrides, but the file wins over them.

    Raises:
        ConfigError: the file cannot be read, or a name or value is not valid.
    """
    data: dict[str, Any] = {}
    for default in defaults:
        _apply_override(data, default)
    if path:
        for section, settings in _read_yaml(path).items():
            both = isinstance(settings, dict) and isinstance(data.get(section), dict)
            data[section] = data[section] | settings if both else settings
    for override in overrides:
        _apply_override(data, override)
    return validated(NssConfig, data, str(path) if path else "--set")


def write_config(config: Section, path: Path) -> None:
    """Write all settings as YAML, to be read by `load_config`.

    Raises:
        FormatError: the file cannot be written.
    """
    write_file(path, yaml.safe_dump(config.model_dump(), sort_keys=False).encode())


def validated(model: type[T], data: Any, origin: str) -> T:
    """The data as a model; its first problem becomes one sentence.

    Raises:
        ConfigError: naming the setting, the problem and where it was set.
    """
    try:
        return model.model_validate(data)
    except ValidationError as error:
        first = error.errors()[0]
        name = ".".join(str(part) for part in first["loc"]) or "the configuration"
        raise ConfigError(
            f"Setting '{name}' in {origin} is not valid: {first['msg']} (got {first['input']!r})."
        ) from error


def _read_yaml(path: Path) -> dict[str, Any]:
    try:
        data = yaml.safe_load(path.read_text())
    except OSError as error:
        raise ConfigError(f"Cannot read configuration {path}: {error.strerror}.") from error
    except _YAML_ERRORS as error:
        raise ConfigError(f"Configuration {path} is not valid YAML: {_one_line(error)}.") from error
    if data is None:
        return {}
    if not isinstance(data, dict):
        raise ConfigError(f"Configuration {path} must hold sections with settings.")
    return data


def _apply_override(data: dict[str, Any], override: str) -> None:
    name, separator, text = override.partition("=")
    if not separator:
        raise ConfigError(f"'--set {override}' needs the form section.name=value.")
    *sections, leaf = name.strip().split(".")
    for section in sections:
        data = data.setdefault(section, {})
        if not isinstance(data, dict):
            raise ConfigError(f"'--set {override}': '{section}' is not a section.")
    try:
        data[leaf] = yaml.safe_load(text)
    except _YAML_ERRORS as error:
        raise ConfigError(f"'--set {override}': '{text}' is not valid YAML; quote it.") from error


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())
