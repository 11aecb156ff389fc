"""`nss config` and `nss methods`: what can be set, and what can be chosen."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
import yaml

from nss_ros.cli.map import ConfigOption, SetOption
from nss_ros.cli.output import print_json
from nss_ros.config import LearnedConfig, RegistrationConfig, load_config, write_config
from nss_ros.errors import InputError
from nss_ros.multiway.synchronizer import synchronizer_names
from nss_ros.registration.method import method_names


def config(
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="File to write; default: print.")
    ] = None,
    config_: ConfigOption = None,
    set_: SetOption = [],  # noqa: B006 - typer reads defaults, nobody changes them
) -> None:
    """Print all settings with their values as YAML, to be changed and given to --config."""
    settings = load_config(config_, set_)
    if output and output.exists():
        raise InputError(f"{output} exists already: choose another name or remove it.")
    if output:
        write_config(settings, output)
    else:
        print(yaml.safe_dump(settings.model_dump(), sort_keys=False), end="")


def methods(
    json: Annotated[bool, typer.Option("--json", help="Print as JSON.")] = False,
) -> None:
    """List the registration methods and synchronizers that are installed."""
    found = {"registration": method_names(), "multiway": synchronizer_names()}
    if json:
        print_json(found)
        return
    for kind, names in found.items():
        print(f"{kind}: {', '.join(names)}")
    learned = [name for name in found["registration"] if _needs_weights(name)]
    print(f"Only with weights as registration.NAME.weights: {', '.join(learned)}")
    print("Their authors publish checkpoints, and 'nss train' makes weights from a dataset.")


def _needs_weights(method: str) -> bool:
    return isinstance(getattr(RegistrationConfig(), method, None), LearnedConfig)
