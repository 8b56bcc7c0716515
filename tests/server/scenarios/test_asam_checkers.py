"""Exported corner cases pass ASAM's own checkers, including the version 1.3 schema."""

from __future__ import annotations

import logging

import pytest

from real2sim_server.scenarios.gallery import GALLERY, corner_case
from real2sim_server.scenarios.openscenario import write_openscenario

qc_openscenario = pytest.importorskip(
    "qc_openscenario.main", reason="asam-qc-openscenarioxml (MPL-2.0) is not installed"
)
qc_baselib = pytest.importorskip("qc_baselib", reason="asam-qc-baselib is not installed")


def issues(path):
    """All issues found by the checkers, and how many checkers completed."""
    configuration, result = qc_baselib.Configuration(), qc_baselib.Result()
    configuration.set_config_param("InputFile", str(path))
    result.register_checker_bundle(
        name="xoscBundle", description="", version="1", build_date="", summary=""
    )
    logging.disable(logging.CRITICAL)
    try:
        qc_openscenario.run_checks(configuration, result)
    finally:
        logging.disable(logging.NOTSET)
    bundle = result.get_checker_bundle_result("xoscBundle")
    found = [issue for checker in bundle.checkers for issue in checker.issues]
    done = [c.checker_id for c in bundle.checkers if c.status == qc_baselib.StatusType.COMPLETED]
    return found, done


@pytest.mark.parametrize("name", GALLERY)
def test_an_exported_case_has_no_issues(tmp_path, name):
    path = tmp_path / f"{name}.xosc"
    path.write_bytes(write_openscenario(corner_case(name).storyboard()))
    found, done = issues(path)

    assert not found
    assert "check_asam_xosc_xml_valid_schema" in done


def test_the_checkers_detect_errors(tmp_path):
    path = tmp_path / "broken.xosc"
    text = write_openscenario(corner_case("ccrb").storyboard()).decode()
    path.write_text(text.replace("<LongitudinalAction>", "<Longitudinal>"))
    assert issues(path)[0]
    path.write_text(text.replace('priority="override"', 'priority="whenever"'))
    assert issues(path)[0]
