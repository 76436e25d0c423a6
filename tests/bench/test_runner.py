"""A contender's process: its errors reach us, and it ends."""

import multiprocessing

import pytest

from torch_panda.bench.contenders import Setting
from torch_panda.bench.runner import ContenderError, Runner


def test_an_error_names_the_contender():
    with pytest.raises(ContenderError, match=r"torch_panda: .*unknown environment id"):
        Runner("torch_panda", Setting("PandaFly-v1", 1, 1))
    assert not multiprocessing.active_children()


def test_a_process_that_dies_is_reported():
    with Runner("torch_panda", Setting("PandaReach-v1", 1, 1)) as runner:
        assert runner.measure(1) > 0
        (process,) = multiprocessing.active_children()
        process.kill()
        with pytest.raises(ContenderError, match="torch_panda: its process ended"):
            runner.measure(1)
    assert not multiprocessing.active_children()
