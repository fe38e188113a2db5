"""Processes that hold a part each (FSDP2) compute and save what one process does."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from processes import Job, assert_close, launch, train
from safetensors.torch import load_file
from synthetic import write_demonstrations
from torch import nn

from imfvla.errors import UserError
from imfvla.storage.run_directory import RunDirectory
from imfvla.training.parallel import Alone
from imfvla.training.sharding import shard

SKIP = {"on_non_finite": "skip"}
SHARDED = {"sharding": "full"}
PAPER = [
    "scale=paper", "size.width=32", "size.heads=2", "size.depth=2", "observation.image_size=[32,32]",
    "training.batch_size=4", "training.steps=2", "training.checkpoints=1", "training.log_every=1",
    "training.threads=1", "training.precision=fp32",
]  # fmt: skip


@pytest.fixture(scope="module")
def runs(tmp_path_factory) -> Path:
    """Trainings of one process, and beside each the one of two processes with a part each."""
    folder = tmp_path_factory.mktemp("runs")

    def job(name, **options):
        return Job(str(folder / name), **options)

    paper = job("paper", overrides=PAPER, demos=str(write_demonstrations(folder / "demonstrations")))
    for one in (job("whole"), job("begun", stops_before=2), job("skipping", nan_in=2, options=SKIP), paper):
        train(one, Alone())
    sharded = [
        job("sharded", options=SHARDED),
        job("begun", options=SHARDED),
        job("handed-over", options=SHARDED, stops_before=2),
        job("skipping-sharded", options=SHARDED | SKIP, nan_in=2),
        replace(paper, run=str(folder / "paper-sharded"), overrides=[*PAPER, "training.sharding=full"]),
    ]
    launch(sharded, folder / "jobs.json")
    return folder


def test_parts_compute_and_save_what_the_whole_does(runs):
    assert_close(runs / "sharded", runs / "whole")
    weights = [load_file(RunDirectory(runs / name).policy_weights()) for name in ("sharded", "whole")]
    torch.testing.assert_close(*weights, rtol=1e-4, atol=1e-6)
    described = [
        json.loads((RunDirectory(runs / name).weights_directory(6) / "policy.json").read_text())
        for name in ("sharded", "whole")
    ]
    assert described[0].keys() == described[1].keys()


def test_a_state_of_the_whole_policy_resumes_sharded_and_back(runs):
    assert_close(runs / "begun", runs / "whole")
    assert train(Job(str(runs / "handed-over")), Alone()) == 3
    assert_close(runs / "handed-over", runs / "whole")


def test_a_batch_that_is_not_finite_is_left_out(runs):
    assert_close(runs / "skipping-sharded", runs / "skipping")


def test_a_parameter_that_cannot_be_divided_is_reported():
    module = nn.Module()
    module.scale = nn.Parameter(torch.ones(()))
    with pytest.raises(UserError, match=r"sharding=full divides parameters .* found none in scale"):
        shard(module, torch.device("cpu"))


def test_a_policy_of_the_papers_scale_is_trained_in_parts(runs):
    """Composed as `scale=paper` says but for sizes, so that it takes seconds."""
    assert_close(runs / "paper-sharded", runs / "paper", steps=2)
