"""What a program prints in a process of its own."""

import os
import pickle
import subprocess
import sys


def printed_by_another_process(code, scans, folder, threads):
    """Output of a program whose argument is a file with pickled scans, with so many threads."""
    file = folder / "scans.pkl"
    file.write_bytes(pickle.dumps(scans))
    libraries = ("OMP", "OPENBLAS", "MKL")
    environment = {f"{library}_NUM_THREADS": str(threads) for library in libraries}
    environment |= {"PYTHONPATH": ":".join(sys.path), "PATH": os.environ["PATH"]}
    done = subprocess.run(
        [sys.executable, "-c", code, str(file)],
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stderr == ""
    return done.stdout
