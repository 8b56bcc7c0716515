from __future__ import annotations

import json
from dataclasses import asdict, replace

import pytest
import torch
from safetensors.torch import load_file, save_file

from real2sim_server.reconstruct import ReconstructError
from real2sim_server.reconstruct.training.records import (
    STATE_FILE,
    TENSOR_FILE,
    Checkpoint,
    read_checkpoint,
    write_checkpoint,
)
from real2sim_server.reconstruct.training.schedule import TrainOptions, from_values

CHECKPOINT = Checkpoint(
    iteration=7,
    counts=(2, 1),
    prior_counts=(1, 0),
    optimizer_steps=7,
    options=asdict(TrainOptions()),
    log_name="drive",
    running={"loss": 0.5, "squared": 0.1, "weight": 0.9},
    tensors={"model.means": torch.arange(9.0).reshape(3, 3), "priors.means": torch.ones(1, 3)},
)


def check_same(read: Checkpoint, given: Checkpoint) -> None:
    no_tensors: dict[str, torch.Tensor] = {}
    # JSON has no tuples, so compare the parsed options.
    assert from_values(TrainOptions, read.options) == from_values(TrainOptions, given.options)
    same = {"tensors": no_tensors, "options": {}}
    assert vars(replace(read, **same)) == vars(replace(given, **same))
    assert read.tensors.keys() == given.tensors.keys()
    assert all(torch.equal(read.tensors[k], given.tensors[k]) for k in given.tensors)


def test_a_checkpoint_round_trips(tmp_path):
    write_checkpoint(CHECKPOINT, tmp_path / "checkpoint")
    check_same(read_checkpoint(tmp_path / "checkpoint"), CHECKPOINT)


def test_version_3_is_read_with_current_names(tmp_path):
    folder = tmp_path / "checkpoint"
    write_checkpoint(CHECKPOINT, folder)
    text = json.dumps(json.loads((folder / STATE_FILE).read_text()) | {"version": 3})
    for new, old in (
        ("prior_counts", "guess_counts"),
        ("prior_round", "guess_round"),
        ("learning_rates", "rates"),
        ("occluded_fraction", "buried_share"),
        ("occluded_depth", "buried_depth"),
        ("fraction", "share"),
    ):
        text = text.replace(f'"{new}"', f'"{old}"')
    (folder / STATE_FILE).write_text(text)
    tensors = load_file(folder / TENSOR_FILE)
    tensors["guesses.means"] = tensors.pop("priors.means")
    save_file(tensors, folder / TENSOR_FILE)
    check_same(read_checkpoint(folder), CHECKPOINT)


def test_older_checkpoints_have_no_box_tilt(tmp_path):
    yaws = {f"{group}.pose_yaw": torch.ones(4, 1) for group in ("model", "adam.first")}
    write_checkpoint(replace(CHECKPOINT, tensors=yaws), tmp_path / "checkpoint")
    read = read_checkpoint(tmp_path / "checkpoint").tensors
    for group in ("model", "adam.first"):
        assert torch.equal(read[f"{group}.pose_tilt"], torch.zeros(4, 2))


def test_other_versions_are_refused(tmp_path):
    folder = tmp_path / "checkpoint"
    write_checkpoint(CHECKPOINT, folder)
    state = json.loads((folder / STATE_FILE).read_text()) | {"version": 2}
    (folder / STATE_FILE).write_text(json.dumps(state))
    with pytest.raises(ReconstructError, match="train from the start"):
        read_checkpoint(folder)
