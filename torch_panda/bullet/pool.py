"""A pool of threads that divide the clients of a simulation among themselves."""

import os
import queue
import threading
from collections.abc import Callable, Iterator, Sequence

Work = Callable[[int], None]


def num_cores() -> int:
    """Number of processor cores that this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # macOS and Windows
        return os.cpu_count() or 1


class _Job:
    """One parallel loop: the indices that threads take, and the errors of the work."""

    def __init__(self, work: Work, indices: Sequence[int], num_threads: int) -> None:
        self.work = work
        # Threads share this iterator without a lock: the GIL makes `next` on an
        # iterator over a sequence atomic.
        self.indices: Iterator[int] = iter(indices)
        self.errors: list[tuple[int, BaseException]] = []
        self._running = num_threads
        self._lock = threading.Lock()
        # Locked until all work is done; `wait` acquires it. A lock wakes a waiting
        # thread faster than a threading.Event.
        self._unfinished = threading.Lock()
        self._unfinished.acquire()

    def take_part(self) -> None:
        """Work until no index is left. The last thread that finishes ends `wait`."""
        for index in self.indices:
            try:
                self.work(index)
            # Also SystemExit: a thread that ended here would let `wait` wait forever.
            except BaseException as error:
                self.errors.append((index, error))
        with self._lock:
            self._running -= 1
            is_last = self._running == 0
        if is_last:
            self._unfinished.release()

    def wait(self) -> None:
        """Return when all work is done."""
        with self._unfinished:
            pass


class _Worker:
    """A thread and the queue through which it gets jobs; None ends it."""

    def __init__(self, name: str) -> None:
        self._jobs: queue.SimpleQueue[_Job | None] = queue.SimpleQueue()
        # A daemon thread does not keep the interpreter alive.
        self._thread = threading.Thread(target=self._loop, name=name, daemon=True)
        self._thread.start()

    def send(self, job: _Job | None) -> None:
        self._jobs.put(job)

    def join(self) -> None:
        self._thread.join()

    def _loop(self) -> None:
        while (job := self._jobs.get()) is not None:
            job.take_part()
            # The job refers to the environment. Drop it, because an idle thread must
            # not keep a forgotten environment alive.
            del job


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
    """Persistent threads that run a function on many indices.

    A thread that finishes an index takes the next one, so that a slow client does not
    delay the others.
    """

    def __init__(self, num_threads: int) -> None:
        self.num_threads = num_threads
        self._workers: list[_Worker] = []
        self._process = os.getpid()
        self._last_job: _Job | None = None

    def run(self, work: Work, indices: Sequence[int]) -> None:
        """Call ``work(index)`` for every index, and return when all calls are done.

        A first Ctrl-C raises when all work is done, so that no client remains in the
        middle of a step. A second Ctrl-C raises at once. The next `run`, `wait` or
        `close` then waits for the rest of the work.

        Raises:
            WorkerError: ``work`` raised for at least one index. All other calls were
                completed, and the error names the lowest index.
        """
        self.wait()
        self._start()
        job = _Job(work, indices, self.num_threads)
        self._last_job = job
        for worker in self._workers:
            worker.send(job)
        try:
            job.wait()
        finally:
            self.wait()
        if job.errors:
            index, error = min(job.errors, key=lambda pair: pair[0])
            raise WorkerError(index, error) from error

    def close(self) -> None:
        """End the threads. Closing again does nothing."""
        self.wait()
        workers, self._workers = self._workers, []
        if self._process != os.getpid():
            return  # a forked child has none of its parent's threads
        for worker in workers:
            worker.send(None)
        for worker in workers:
            worker.join()

    def wait(self) -> None:
        """Wait until the last job is done.

        If a second Ctrl-C interrupted `run`, threads may still be working on its job.
        """
        if self._last_job is not None and self._process == os.getpid():
            self._last_job.wait()
        self._last_job = None

    def _start(self) -> None:
        if self._process != os.getpid():  # in a forked child
            self._process = os.getpid()
            self._workers = []
        if not self._workers:
            self._workers = [
                _Worker(f"torch_panda-{k}") for k in range(self.num_threads)
            ]
