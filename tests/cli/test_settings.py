"""`nss config` and `nss methods`."""

import json

import yaml
from typer.testing import CliRunner

from nss_ros.cli.main import app
from nss_ros.config import load_config
from nss_ros.errors import InputError


def run(*arguments):
    return CliRunner().invoke(app, [str(each) for each in arguments])


def test_what_is_printed_is_what_is_written(tmp_path):
    file = tmp_path / "settings.yaml"
    options = ["-s", "registration.method=fpfh_fgr"]
    assert run("config", *options, "-o", file).exit_code == 0
    assert load_config(file).registration.method == "fpfh_fgr"
    printed = run("config", "--config", file)
    assert yaml.safe_load(printed.output) == yaml.safe_load(file.read_text())


def test_settings_that_somebody_changed_are_not_overwritten(tmp_path):
    file = tmp_path / "settings.yaml"
    file.write_text("registration: {method: fpfh_fgr}\n")
    result = run("config", "-o", file)
    assert isinstance(result.exception, InputError)
    assert "exists already" in str(result.exception)
    assert file.read_text() == "registration: {method: fpfh_fgr}\n"


def test_methods_are_listed_with_what_they_need():
    lines = run("methods").output.splitlines()
    assert "gravity" in lines[0]
    assert "submaps" in lines[1]
    assert lines[2].endswith(": d3feat, fcgf, geotransformer, predator")
    assert "predator" in json.loads(run("methods", "--json").output)["registration"]
