"""The pretended device raises the errors of a GPU."""

from __future__ import annotations

import functools

import numpy as np
import pytest
import torch

from .pretended import DEVICE, Counts, MixedDevicesError

NAME = "pretended"


def test_operations_on_tensors_of_two_devices_are_refused(device_counts: Counts) -> None:
    here = torch.zeros(3, device=NAME)
    with pytest.raises(MixedDevicesError, match="cpu"):
        here + torch.ones(3)
    with pytest.raises(MixedDevicesError):
        torch.ones(3)[torch.tensor([1], device=NAME)]
    assert float((here + 1.5).sum()) == 4.5


def test_converting_a_device_tensor_to_numpy_is_refused(device_counts: Counts) -> None:
    here = torch.zeros(3, device=NAME)
    for convert in (here.numpy, functools.partial(np.asarray, here)):
        with pytest.raises(TypeError, match="cpu"):
            convert()


def test_gradients_are_on_the_device_of_their_leaf(device_counts: Counts) -> None:
    on_host = torch.ones(3, requires_grad=True)
    (on_host.to(NAME) * 2).sum().backward()
    assert on_host.grad is not None
    assert on_host.grad.device == torch.device("cpu")
    here = torch.zeros(3, device=NAME, requires_grad=True)
    (here + 1).square().sum().backward()
    assert here.grad is not None
    assert here.grad.device.type == NAME


def test_launches_copies_and_waits_are_counted(device_counts: Counts) -> None:
    here = torch.ones(3).to(NAME)
    assert (device_counts.to_device, device_counts.to_host, device_counts.waits) == (1, 0, 0)
    launched = device_counts.launches
    total = (here * 2).sum()
    assert device_counts.launches == launched + 2
    assert float(total) == 6
    assert device_counts.waits == 1
    here.cpu()
    assert DEVICE.type in ("cpu", NAME)
    assert device_counts.to_host == 1
