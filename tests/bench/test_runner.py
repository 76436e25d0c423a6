"""A contender's process: its errors reach us, and it ends."""

import multiprocessing
import subprocess
import sys
import time

import pytest

from torch_panda.bench import processes
from torch_panda.bench.runner import ContenderError, Runner
from torch_panda.bench.stepping import Setting


def test_an_error_names_the_contender():
    with pytest.raises(ContenderError, match=r"torch_panda: .*unknown environment id"):
        Runner("torch_panda", Setting("PandaFly-v1", 1, 1))
    assert not multiprocessing.active_children()


def test_a_process_that_dies_is_reported():
    with Runner("torch_panda", Setting("PandaReach-v1", 1, 1)) as runner:
        assert runner.measure(1).per_second > 0
        (process,) = multiprocessing.active_children()
        process.kill()
        with pytest.raises(ContenderError, match="torch_panda: its process ended"):
            runner.measure(1)
    assert not multiprocessing.active_children()


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_use_is_summed_over_child_processes():
    code = (
        "import time; x = bytearray(50_000_000); y = sum(range(3 * 10**7)); "
        "print('used', flush=True); time.sleep(99)"
    )

    def cpu_time_of_children():
        return processes.cpu_time() - time.process_time()

    memory_before, cpu_before = processes.memory(), cpu_time_of_children()
    command = (sys.executable, "-c", code)
    child = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert child.stdout.readline() == "used\n"
        assert cpu_time_of_children() > cpu_before + 0.1
        assert processes.memory() > memory_before + 40  # [MB]
    finally:
        child.kill()
        child.communicate()
