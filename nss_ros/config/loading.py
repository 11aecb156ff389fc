"""All settings together, read from YAML and `section.name=value` overrides."""

from __future__ import annotations

from collections.abc import Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import yaml
from pydantic import ValidationError

from nss_ros.config.dataset import DatasetConfig
from nss_ros.config.run import (
    PlayerConfig,
    PoseGraphConfig,
    RecorderConfig,
    RegistrationNodeConfig,
)
from nss_ros.config.section import Section, T
from nss_ros.config.simulation import SimulationConfig
from nss_ros.config.training import TrainingConfig
from nss_ros.errors import ConfigError
from nss_ros.files import write_file

# Dates that do not exist are a ValueError, deep nesting ends in a RecursionError.
_YAML_ERRORS = (yaml.YAMLError, ValueError, RecursionError)


class NssConfig(Section):
    """Everything: one section per node, the simulator's, the dataset's and that of training."""

    player: PlayerConfig = PlayerConfig()
    registration: RegistrationNodeConfig = RegistrationNodeConfig()
    pose_graph: PoseGraphConfig = PoseGraphConfig()
    recorder: RecorderConfig = RecorderConfig()
    simulation: SimulationConfig = SimulationConfig()
    dataset: DatasetConfig = DatasetConfig()
    training: TrainingConfig = TrainingConfig()


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
        if first["type"] == "extra_forbidden":
            hint = _known_settings(model, first["loc"])
            raise ConfigError(f"There is no setting '{name}' ({origin}){hint}") from error
        raise ConfigError(
            f"Setting '{name}' in {origin} is not valid: {first['msg']} (got {first['input']!r})."
        ) from error


def _known_settings(model: type[Section], location: tuple[int | str, ...]) -> str:
    """What a name that does not exist may have meant, as the end of a sentence."""
    *sections, unknown = location
    for section in sections:
        field = model.model_fields.get(str(section))
        if field is None or not (
            isinstance(field.annotation, type) and issubclass(field.annotation, Section)
        ):
            return "."
        model = field.annotation
    close = get_close_matches(str(unknown), model.model_fields, 1)
    if close:
        return f": did you mean '{'.'.join([*map(str, sections), *close])}'?"
    return f": there are {', '.join(model.model_fields)}."


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
