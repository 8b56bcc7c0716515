"""All usable backends and a custom one fulfil the backend contract."""

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
def test_backends_fulfil_the_contract(name):
    check_contract(name)


@pytest.fixture
def single():
    """Register the reference in float32 as a custom backend for one test."""
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


def test_a_custom_backend_fulfils_the_contract(single):
    check_contract(single)


def test_a_custom_backend_is_listed_but_not_selected_automatically(single):
    assert single in {status.name for status in describe_backends()}
    assert not isinstance(select_backend("auto"), ReferenceBackend)


def test_registering_a_backend_twice_is_refused(single):
    with pytest.raises(ValueError, match="'single' is registered already"):
        register_backend(BACKENDS[single])


def test_an_unknown_backend_is_refused_with_the_available_ones(single):
    with pytest.raises(RenderError, match=r"\['cpu', 'cuda', 'nvrtc', 'reference', 'single'\]"):
        select_backend("vulkan")
