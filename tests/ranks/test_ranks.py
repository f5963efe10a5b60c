"""What one rank does without others."""

import re

import pytest
import torch

from ddrecon.errors import RanksError
from ddrecon.ranks import from_first, is_any, is_first, join_ranks, sum_over_ranks


def test_one_rank_exchanges_nothing():
    tensor, value = torch.rand(3), object()
    assert sum_over_ranks([tensor])[0] is tensor
    assert from_first(value) is value
    assert is_first() and is_any(True) and not is_any(False)


def started(monkeypatch, **variables):
    for name in ("RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT"):
        monkeypatch.delenv(name, raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)


@pytest.mark.parametrize(
    ("port", "address"), [({"MASTER_PORT": "9"}, "127.0.0.1:9"), ({}, "127.0.0.1:?")]
)
def test_ranks_that_cannot_be_reached_are_told_in_a_line(monkeypatch, port, address):
    started(monkeypatch, RANK="1", WORLD_SIZE="2", MASTER_ADDR="127.0.0.1", **port)
    monkeypatch.setenv("DDRECON_MEET_SECONDS", "0.2")
    message = f"rank 1 of 2 cannot meet the others at {address} within 0.2 s"
    with pytest.raises(RanksError, match="^" + re.escape(message)):
        join_ranks(has_gpu=False)


def test_a_single_process_of_torchrun_meets_nobody(monkeypatch):
    started(monkeypatch, RANK="0", WORLD_SIZE="1", MASTER_ADDR="192.0.2.1", MASTER_PORT="9")
    join_ranks(has_gpu=False)
    assert is_first() and not torch.distributed.is_initialized()
