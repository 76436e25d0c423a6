"""Threads of Python that work on many environments."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait

Work = Callable[[int], None]


def num_cores() -> int:
    """Number of processor cores that this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # macOS and Windows
        return os.cpu_count() or 1


class WorkerError(RuntimeError):
    """The work on at least one environment failed. The work on the others was done.

    Args:
        index: Lowest index of an environment whose work failed.
        error: The error that this work raised.
    """

    def __init__(self, index: int, error: BaseException) -> None:
        super().__init__(f"environment {index}: {type(error).__name__}: {error}")
        self.index = index


class WorkerPool:
    """Threads that run a function on many indices.

    The first `run` starts the threads. In a forked child, which has none of its
    parent's threads, the first `run` starts new ones.

    Args:
        num_threads: Number of threads.
    """

    def __init__(self, num_threads: int) -> None:
        self.num_threads = num_threads
        self._executor: ThreadPoolExecutor | None = None
        self._process = os.getpid()

    def run(self, work: Work, indices: Sequence[int]) -> None:
        """Call ``work(index)`` for every index, and return when all calls are done.

        A first Ctrl-C raises when all calls are done, so that no client remains in the
        middle of a step. A second Ctrl-C raises at once; close the environment then.

        Raises:
            WorkerError: ``work`` raised for at least one index. All other calls were
                completed, and the error names the lowest index.
        """
        if self._executor is None or self._process != os.getpid():
            self._process = os.getpid()
            self._executor = ThreadPoolExecutor(self.num_threads, "torch_panda")
        try:
            futures = {index: self._executor.submit(work, index) for index in indices}
            wait(futures.values())
        except KeyboardInterrupt:
            self.close()  # waits for all calls
            raise
        for index in sorted(futures):
            if error := futures[index].exception():
                raise WorkerError(index, error) from error

    def close(self) -> None:
        """Wait for running calls and end the threads. Closing again does nothing."""
        if self._executor is not None and self._process == os.getpid():
            self._executor.shutdown()
        self._executor = None
