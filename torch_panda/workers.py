"""Worker processes that die while others wait for them."""

import signal
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from multiprocessing.process import BaseProcess


@contextmanager
def name_dead_workers(processes: Iterable[BaseProcess]) -> Iterator[None]:
    """Let an error that a killed worker has caused name the worker.

    torchrl's multi-process collectors notice a killed worker within about a second, and
    then end the others. When these take longer than 0.1 s to end, as large environments
    do, torchrl 0.14 raises an error about them that does not tell who died::

        with name_dead_workers(collector.procs):
            for data in collector:
                ...

    Args:
        processes: the workers, ``collector.procs``.

    Raises:
        RuntimeError: a worker has died; it names the worker and its exit code.
    """
    workers = [(process, _pid(process)) for process in processes]
    try:
        yield
    except (RuntimeError, ValueError) as error:
        for index, (process, pid) in enumerate(workers):
            if (code := _exit_code(process)) is not None:
                raise RuntimeError(
                    f"worker {index} (process {pid}) died with exit code {code}"
                ) from error
        raise


def _pid(process: BaseProcess) -> int | None:
    """None of a process that torchrl has closed."""
    try:
        return process.pid
    except ValueError:
        return None


def _exit_code(process: BaseProcess) -> int | None:
    """Of a process that died by itself; None for one that lives or was ended."""
    try:
        code = process.exitcode
    except ValueError:  # torchrl has closed it, which it does with those it ends
        return None
    return None if code in (0, -signal.SIGTERM) else code
