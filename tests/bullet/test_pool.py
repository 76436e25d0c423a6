"""The thread pool does all work, names errors, survives Ctrl-C and ends its threads."""

import signal
import threading
import time

import pytest

from torch_panda.bullet.pool import WorkerError, WorkerPool


def own_threads():
    return [t for t in threading.enumerate() if t.name.startswith("torch_panda")]


@pytest.fixture
def pool():
    # Environments of other tests in the same process may have pools of their own.
    threads_before = own_threads()
    pool = WorkerPool(3)
    yield pool
    pool.close()
    assert not set(own_threads()) - set(threads_before)


def test_several_threads_process_every_index_once(pool):
    done, names = [], set()

    def work(index):
        time.sleep(0.002)
        done.append(index)
        names.add(threading.current_thread().name)

    for _ in range(20):
        done.clear()
        pool.run(work, range(10))
        assert sorted(done) == list(range(10))
    assert len(names) == 3


def test_a_slow_index_does_not_delay_the_others(pool):
    finished = []

    def work(index):
        time.sleep(0.2 if index == 0 else 0.001)
        finished.append(index)

    pool.run(work, range(30))
    assert finished[-1] == 0
    assert len(finished) == 30


def test_an_error_names_its_index_and_the_other_calls_complete(pool):
    done = []

    def work(index):
        if index in (2, 5):
            raise ValueError("broken")
        done.append(index)

    with pytest.raises(WorkerError, match="environment 2: ValueError: broken") as info:
        pool.run(work, range(8))
    assert info.value.index == 2
    assert isinstance(info.value.__cause__, ValueError)
    assert sorted(done) == [0, 1, 3, 4, 6, 7]
    pool.run(done.append, [9])
    assert done[-1] == 9


def test_an_interrupt_waits_for_the_running_work(pool):
    done = []

    def work(index):
        time.sleep(0.02)
        done.append(index)

    timer = threading.Timer(
        0.05, signal.pthread_kill, (threading.main_thread().ident, signal.SIGINT)
    )
    timer.start()
    with pytest.raises(KeyboardInterrupt):
        pool.run(work, range(20))
    assert sorted(done) == list(range(20))
    timer.join()


def test_a_pool_may_be_closed_twice_and_used_again(pool):
    pool.close()
    pool.close()
    done = []
    pool.run(done.append, [1])
    assert done == [1]
