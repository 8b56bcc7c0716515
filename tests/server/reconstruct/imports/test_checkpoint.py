from pathlib import Path

import numpy as np
import pytest
import torch

from real2sim_server.reconstruct.imports import (
    CheckpointError,
    CheckpointOptions,
    import_checkpoint,
)
from real2sim_server.reconstruct.imports.checkpoint import load_checkpoint
from real2sim_server.reconstruct.imports.street_gaussians import fourier_basis


class Trap:
    """An object that runs code when unpickled."""

    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self):
        return Path.touch, (self.marker,)


@pytest.mark.parametrize("as_zip", [True, False])
def test_code_in_a_checkpoint_is_never_run(tmp_path, as_zip):
    state = {"background": Trap(tmp_path / "was here")}
    torch.save(state, tmp_path / "a.pth", _use_new_zipfile_serialization=as_zip)
    with pytest.raises(CheckpointError, match=r"a\.pth: "):
        import_checkpoint(tmp_path / "a.pth")
    assert not (tmp_path / "was here").exists()


def test_pickled_code_is_named_in_the_error(tmp_path):
    torch.save({"background": Trap(tmp_path / "x")}, tmp_path / "a.pth")
    with pytest.raises(CheckpointError, match=r"besides tensors .*(touch|Path).*tensors only"):
        import_checkpoint(tmp_path / "a.pth")


@pytest.mark.parametrize("as_zip", [True, False])
def test_tensors_numbers_and_numpy_scalars_are_read(tmp_path, as_zip):
    state = {
        "a": torch.nn.Parameter(torch.ones(2)),
        "b": np.float64(2.5),
        "c": {"d": [1, "x"]},
        "e": np.int64(7),
        "f": np.float32(1.5),
    }
    torch.save(state, tmp_path / "a.pth", _use_new_zipfile_serialization=as_zip)
    back = load_checkpoint(tmp_path / "a.pth")
    assert (back["b"], back["c"], back["e"], back["f"]) == (2.5, {"d": [1, "x"]}, 7, 1.5)
    assert back["a"].tolist() == [1, 1]


@pytest.mark.parametrize("data", [b"", b"hello", b"PK\x03\x04" + bytes(50), b"\x80\x02."])
def test_a_file_that_is_not_a_checkpoint_is_refused(tmp_path, data):
    (tmp_path / "a.pth").write_bytes(data)
    with pytest.raises(CheckpointError, match=r"a\.pth: .*no checkpoint of torch, or damaged"):
        load_checkpoint(tmp_path / "a.pth")


def test_a_truncated_checkpoint_is_refused(tmp_path):
    torch.save({"a": torch.zeros(1000)}, tmp_path / "a.pth")
    whole = (tmp_path / "a.pth").read_bytes()
    for end in range(1, len(whole), 301):
        (tmp_path / "a.pth").write_bytes(whole[:end])
        with pytest.raises(CheckpointError, match=r"a\.pth"):
            load_checkpoint(tmp_path / "a.pth")


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(CheckpointError, match=r"a\.pth: cannot be read"):
        load_checkpoint(tmp_path / "a.pth")


def test_unknown_checkpoints_are_refused_with_their_keys(tmp_path):
    torch.save({"state_dict": {}, "epoch": 3}, tmp_path / "a.pth")
    with pytest.raises(CheckpointError, match=r"holds \['epoch', 'state_dict'\]; a Street"):
        import_checkpoint(tmp_path / "a.pth")
    torch.save([1, 2], tmp_path / "a.pth")
    with pytest.raises(CheckpointError, match="holds a list, a checkpoint is a dict"):
        import_checkpoint(tmp_path / "a.pth")


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"first_frame": -1}, "frames -1 to None"),
        ({"first_frame": 5, "last_frame": 4}, "frames 5 to 4"),
        ({"cameras": ()}, "cameras is empty"),
        ({"frame_rate": 0.0}, "frame_rate must be positive"),
        ({"frame_rate": float("nan")}, "frame_rate must be positive"),
        ({"world": "up"}, "world 'up'; allowed are"),
    ],
)
def test_invalid_options_are_refused(options, reason):
    with pytest.raises(CheckpointError, match=reason):
        CheckpointOptions(**options)


def test_the_fourier_basis_has_period_one():
    t = 0.13
    full = 2 * np.pi * t
    expected = [1, np.sin(full), np.cos(full), np.sin(2 * full), np.cos(2 * full)]
    np.testing.assert_allclose(fourier_basis(t, 5), expected)
    np.testing.assert_allclose(fourier_basis(0.0, 5), fourier_basis(1.0, 5), atol=1e-12)
