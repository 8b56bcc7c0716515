"""Every registered splat format keeps the contract."""

import pytest

from real2sim_server.scene.io.splats import FORMATS

from . import format_contract as contract

formats = pytest.mark.parametrize("splat_format", FORMATS, ids=lambda known: known.suffix)


@formats
def test_it_is_told_from_the_others(splat_format):
    contract.check_description(splat_format)


@formats
def test_what_it_writes_is_known_to_be_its_own(splat_format, make_cloud, tmp_path):
    contract.check_file_is_its_own(splat_format, make_cloud(20), tmp_path)


@formats
def test_gaussians_come_back(splat_format, make_cloud, tmp_path):
    contract.check_round_trip(splat_format, make_cloud, tmp_path)


@formats
def test_the_same_gaussians_give_the_same_bytes(splat_format, make_cloud, tmp_path):
    contract.check_same_bytes(splat_format, make_cloud, tmp_path)


@formats
def test_a_file_cut_short_is_refused(splat_format, make_cloud, tmp_path):
    contract.check_damage_is_refused(splat_format, make_cloud(20), tmp_path)
