"""A lock that refuses a second thread instead of letting it wait."""

import threading

from torch_panda.bullet.connection import BulletError


class ThreadGuard:
    """A context manager that one thread at a time may enter.

    Two threads in one Bullet client crash the interpreter. The thread that is inside
    may enter again.

    Raises:
        BulletError: Another thread is inside.
    """

    def __init__(self) -> None:
        self._lock = threading.RLock()

    def __enter__(self) -> None:
        if not self._lock.acquire(blocking=False):
            raise BulletError(
                "another thread is using this environment: it serves one thread at a "
                "time, so make an environment for each thread"
            )

    def __exit__(self, *error: object) -> None:
        self._lock.release()
