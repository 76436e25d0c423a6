"""One thread at a time."""

import threading

from torch_panda.bullet.connection import BulletError


class ThreadGuard:
    """Lets one thread in, and refuses the others for as long as it is there.

    Bullet's clients are not for two threads at once: they crash the interpreter. The
    thread that is in may enter again, and another one once it has left.
    """

    def __init__(self) -> None:
        self._lock = threading.RLock()

    def __enter__(self) -> None:
        if not self._lock.acquire(blocking=False):
            raise BulletError(
                "another thread is using this environment: it serves one thread at a "
                "time, so give each thread an environment of its own"
            )

    def __exit__(self, *error: object) -> None:
        self._lock.release()
