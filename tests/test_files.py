import resource

import pytest

from nss_ros.errors import FormatError
from nss_ros.files import write_file


def test_a_file_is_replaced(tmp_path):
    write_file(tmp_path / "x", b"old")
    write_file(tmp_path / "x", b"new")
    assert (tmp_path / "x").read_bytes() == b"new"
    assert [path.name for path in tmp_path.iterdir()] == ["x"]


@pytest.mark.parametrize("path", ["nowhere/x", "/dev/full", "."])
def test_what_cannot_be_written_is_named(tmp_path, path):
    with pytest.raises(FormatError, match="Cannot write"):
        write_file(tmp_path / path, b"data")


def test_a_failure_keeps_the_old_file(tmp_path):
    write_file(tmp_path / "x", b"old")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, hard))  # the file runs full half-way
    try:
        with pytest.raises(FormatError, match="File too large"):
            write_file(tmp_path / "x", bytes(1000))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert (tmp_path / "x").read_bytes() == b"old"
    assert [path.name for path in tmp_path.iterdir()] == ["x"]
