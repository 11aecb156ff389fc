"""The `nss` command line."""

import sys


def main() -> None:
    """Entry point of `nss`: imports, which take a moment, may be interrupted quietly too."""
    try:
        from nss_ros.cli.main import main as run
    except KeyboardInterrupt:
        sys.exit(130)
    run()
