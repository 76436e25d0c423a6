"""Checked commands to one client of Bullet."""

from collections.abc import Sequence
from ctypes import Array, c_double

import numpy as np
import numpy.typing as npt

from torch_panda.bullet import capi


class BulletError(RuntimeError):
    """Bullet refused a command, or a simulation was used in a wrong way."""


class Connection:
    """Owns a client's handle, submits commands and checks their status codes.

    One thread at a time may use a client. Clients of one process are independent:
    different threads may use different clients at the same time.

    Args:
        handle: Bullet's handle of the client; None or 0 if Bullet could not create it.

    Raises:
        BulletError: Bullet could not create the client.
    """

    def __init__(self, handle: int | None) -> None:
        if not handle:
            raise BulletError("Bullet could not create a client")
        self._handle: int | None = handle

    @property
    def handle(self) -> int:
        """Bullet's handle of the client.

        Raises:
            BulletError: The client is closed.
        """
        if self._handle is None:
            raise client_closed()
        return self._handle

    def submit(self, command: int, expected: int, action: str) -> int:
        """Submit a command, release the GIL while Bullet works, and check the answer.

        Args:
            command: Handle of the command.
            expected: Status code of success.
            action: What the command does, for the error.

        Returns:
            Handle of the status, valid until the next command.

        Raises:
            BulletError: The client is closed, or Bullet answered with a different code.
        """
        status: int | None = capi.submit(self.handle, command)
        code = capi.status_type(status) if status else None
        if status is None or code != expected:
            raise refusal(action, code, expected)
        return status

    def close(self) -> None:
        """Free the client. Closing again does nothing."""
        # Ctrl-C raises after `disconnect` has freed the client, so forget it before.
        handle, self._handle = self._handle, None
        if handle is not None:
            capi.disconnect(handle)


def connect() -> Connection:
    """Create a client without a window (pybullet's ``DIRECT``)."""
    return Connection(capi.connect_direct())


def refusal(action: str, code: int | None, expected: int) -> BulletError:
    """The error for a command that Bullet did not answer as expected."""
    answer = "gave no answer" if code is None else f"answered with status {code}"
    return BulletError(f"Bullet could not {action}: it {answer}, expected {expected}")


def client_closed() -> BulletError:
    """The error for a command to a closed client."""
    return BulletError("the physics client is closed")


def doubles(values: Sequence[float]) -> Array[c_double]:
    """A new C array of doubles."""
    return (c_double * len(values))(*values)


def shared_doubles(row: npt.NDArray[np.float64]) -> Array[c_double]:
    """A C array that shares the memory of a contiguous numpy array, (k,)."""
    return (c_double * len(row)).from_buffer(row.data)
