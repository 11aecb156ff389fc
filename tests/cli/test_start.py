"""What every command waits for."""

import subprocess
import sys

_SLOW = {"open3d", "sklearn", "torch", "matplotlib", "plotly", "pandas", "ray", "rerun"}


def test_libraries_that_take_long_are_loaded_when_they_are_wanted_only():
    command = "import sys, nss_ros.cli.main; print(*{each.split('.')[0] for each in sys.modules})"
    loaded = subprocess.run(
        [sys.executable, "-c", command], capture_output=True, text=True, check=True
    ).stdout.split()
    assert "nss_ros" in loaded
    assert not _SLOW & set(loaded)
