"""Threads of Python that work on many environments."""

import multiprocessing
import signal
import threading
import time
import weakref

import pytest

from torch_panda.bullet import WorkerError, WorkerPool


@pytest.fixture
def pool():
    pool = WorkerPool(2)
    yield pool
    pool.close()


def test_an_error_names_the_lowest_index_and_all_calls_are_completed(pool):
    completed = set()

    def work(index):
        time.sleep(0.01 * (4 - index))  # the higher ones fail first
        if index in (1, 3):
            raise ValueError(f"no {index}")
        completed.add(index)

    with pytest.raises(
        WorkerError, match=r"^environment 1: ValueError: no 1$"
    ) as error:
        pool.run(work, range(5))
    assert error.value.index == 1
    assert completed == {0, 2, 4}


def test_an_interrupt_is_raised_when_all_calls_are_done(pool):
    all_started = threading.Barrier(2)
    pool.run(lambda index: all_started.wait(60), range(2))  # starts both threads
    completed = []

    def work(index):
        if index == 0:
            signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)
        time.sleep(0.05)
        completed.append(index)

    with pytest.raises(KeyboardInterrupt):
        pool.run(work, range(4))
    assert sorted(completed) == list(range(len(completed)))
    assert completed
    pool.run(completed.append, [7])
    assert completed[-1] == 7


def test_a_forked_child_starts_threads_of_its_own(pool):
    pool.run(lambda index: None, range(4))
    receiver, sender = multiprocessing.Pipe(duplex=False)

    def child():
        pool.run(sender.send, range(4))
        pool.close()

    process = multiprocessing.get_context("fork").Process(target=child)
    process.start()
    try:
        process.join(60)
        assert process.exitcode == 0
        assert {receiver.recv() for _ in range(4)} == {0, 1, 2, 3}
    finally:
        process.kill()


def test_idle_threads_do_not_keep_the_work_alive(pool):
    class Work:
        def __call__(self, index):
            pass

    work = Work()
    reference = weakref.ref(work)
    pool.run(work, range(4))
    del work
    deadline = time.monotonic() + 10
    while reference() is not None:
        assert time.monotonic() < deadline
        time.sleep(0.001)


def test_a_pool_can_be_used_again_after_it_was_closed(pool):
    threads = set()
    for _ in range(2):
        pool.run(lambda index: threads.add(threading.current_thread()), range(4))
        pool.close()
        assert not any(thread.is_alive() for thread in threads)
    pool.close()
