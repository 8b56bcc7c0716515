"""Every backend that is usable here keeps the contract, one from outside of the package too."""

import pytest
import torch

from real2sim_server.render import RenderError, describe_backends, select_backend
from real2sim_server.render._reference import ReferenceBackend
from real2sim_server.render.select import (
    BACKENDS,
    BackendStatus,
    RegisteredBackend,
    register_backend,
)

from .backend_contract import check_contract

ON_GPU = ("cuda", "nvrtc")


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(status.name, marks=[pytest.mark.gpu] if status.name in ON_GPU else [])
        for status in describe_backends()
        if status.usable
    ],
)
def test_a_backend_keeps_the_contract(name):
    check_contract(name)


@pytest.fixture
def single():
    """The plain rasterizer in single precision, registered for one test."""
    before = dict(BACKENDS)
    register_backend(
        RegisteredBackend(
            status=lambda: BackendStatus("single", True, "plain torch in float32"),
            make=lambda: ReferenceBackend(dtype=torch.float32),
        )
    )
    yield "single"
    BACKENDS.clear()
    BACKENDS.update(before)
    select_backend.cache_clear()


def test_a_backend_from_outside_keeps_the_contract(single):
    check_contract(single)


def test_a_backend_from_outside_is_described_and_not_chosen_by_itself(single):
    assert single in {status.name for status in describe_backends()}
    assert not isinstance(select_backend("auto"), ReferenceBackend)


def test_a_name_that_is_taken_is_refused(single):
    with pytest.raises(ValueError, match="'single' is registered already"):
        register_backend(BACKENDS[single])


def test_an_unknown_backend_is_refused_with_those_there_are(single):
    with pytest.raises(RenderError, match=r"\['cpu', 'cuda', 'nvrtc', 'reference', 'single'\]"):
        select_backend("vulkan")
