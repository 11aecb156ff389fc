"""Which code is running: versions of packages and the git revision."""

from __future__ import annotations

import platform
import subprocess
import time
from collections.abc import Iterable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from nss_ros import __version__

_RUN_PACKAGES = ("mcap", "numpy", "open3d", "open3d-cpu", "rosbags", "scipy", "torch")


def git_revision() -> str:
    """The git revision of this package's source, `-dirty` with changes; `unknown` outside git."""
    command = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def package_versions(packages: Iterable[str]) -> dict[str, str]:
    """The versions of those packages that are installed."""
    versions = {}
    for package in packages:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            continue
    return versions


def run_versions() -> dict[str, str]:
    """What a log tells of the code and the machine that made it, and when it began (UTC)."""
    values = {
        "nss_ros": __version__,
        "git_revision": git_revision(),
        "python": platform.python_version(),
        "platform": platform.platform(),
        "start_time": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
    }
    installed = package_versions(_RUN_PACKAGES)
    return values | {f"version_{package}": number for package, number in installed.items()}
