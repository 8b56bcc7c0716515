"""Every registered splat format fulfils the contract."""

import pytest

from real2sim_server.scene.io.splats import FORMATS

from . import format_contract as contract

formats = pytest.mark.parametrize("splat_format", FORMATS, ids=lambda known: known.suffix)


@formats
def test_a_format_is_distinguished_from_others(splat_format):
    contract.check_description(splat_format)


@formats
def test_written_files_are_recognised(splat_format, make_cloud, tmp_path):
    contract.check_file_is_its_own(splat_format, make_cloud(20), tmp_path)


@formats
def test_gaussians_round_trip(splat_format, make_cloud, tmp_path):
    contract.check_round_trip(splat_format, make_cloud, tmp_path)


@formats
def test_writing_is_reproducible(splat_format, make_cloud, tmp_path):
    contract.check_same_bytes(splat_format, make_cloud, tmp_path)


@formats
def test_a_truncated_file_is_refused(splat_format, make_cloud, tmp_path):
    contract.check_damage_is_refused(splat_format, make_cloud(20), tmp_path)
