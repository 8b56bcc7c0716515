"""Threads of torch while training."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Run small torch operations on the calling thread; compiled loops keep all cores.

    A step has hundreds of operations of some microseconds each. Where another program wants the
    cores as well, torch's threads wait for each other at every one of them: six times slower,
    measured with two cores and three busy programs.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
