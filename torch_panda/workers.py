"""Names the worker process that died while others waited for it."""

import signal
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from multiprocessing.process import BaseProcess


@contextmanager
def name_dead_workers(processes: Iterable[BaseProcess]) -> Iterator[None]:
    """Context manager that makes the error of a killed worker name the worker.

    torchrl's multi-process collectors notice a killed worker within about a second and
    then end the other workers. If a worker takes longer than 0.1 s to end, which is
    common with large environments, the error of torchrl 0.14 does not say which worker
    was killed::

        with name_dead_workers(collector.procs):
            for data in collector:
                ...

    Args:
        processes: The worker processes, ``collector.procs``.

    Raises:
        RuntimeError: A worker died. The error names the worker and its exit code.
    """
    try:
        yield
    except (RuntimeError, ValueError) as error:
        for index, process in enumerate(processes):
            if (code := _exit_code(process)) is not None:
                raise RuntimeError(
                    f"worker {index} (process {process.pid}) died with exit code {code}"
                ) from error
        raise


def _exit_code(process: BaseProcess) -> int | None:
    """Exit code of a process that failed.

    None if the process still runs, ended normally, or was ended by torchrl.
    """
    try:
        code = process.exitcode
    except ValueError:  # torchrl closes the processes that it ends
        return None
    return None if code in (0, -signal.SIGTERM) else code
