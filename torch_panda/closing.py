"""What owns something that must be freed."""

from types import TracebackType
from typing import Protocol, TypeVar

_Self = TypeVar("_Self", bound="Closing")


class _HasClose(Protocol):
    def close(self) -> None: ...


class Closing:
    """Calls its ``close()`` at the end of a ``with`` block."""

    def __enter__(self: _Self) -> _Self:
        return self

    def __exit__(
        self: _HasClose,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()
