"""The extension module that the pybullet wheel installs: found, loaded and bound.

It is opened twice, because ctypes ties the lock to the library object:

* ``CDLL`` releases the GIL around a call. It serves the calls that do real work, so
  that clients in different threads step at the same time.
* ``PyDLL`` keeps the GIL. It serves the setters, which take less time than handing
  the lock over; through ``CDLL`` two threads would pass it back and forth.

The file is found, not imported: importing pybullet prints a line on stdout.
"""

import ctypes
import importlib.metadata
import importlib.util
from typing import Any

SUPPORTED_VERSION = "3.2.7"


def wrong_pybullet(reason: str) -> ImportError:
    """The one error for a pybullet whose C API is not the one declared here."""
    try:
        installed = importlib.metadata.version("pybullet")
    except importlib.metadata.PackageNotFoundError:
        installed = "none"
    return ImportError(
        f"torch_panda calls Bullet's C API through pybullet, and {reason} "
        f"(installed: {installed}). Version {SUPPORTED_VERSION} works: "
        f"pip install pybullet=={SUPPORTED_VERSION}"
    )


def library_path(module: str = "pybullet") -> str:
    """Path of the extension module, without importing it."""
    spec = importlib.util.find_spec(module)
    if spec is None or spec.origin is None:
        raise wrong_pybullet("pybullet is not installed")
    return spec.origin


def bind(library: ctypes.CDLL, name: str, result: Any, *arguments: Any) -> Any:  # noqa: ANN401 (ctypes function types)
    """Declare one C function.

    Raises:
        ImportError: the library does not export the name.
    """
    try:
        function = getattr(library, name)
    except AttributeError:
        raise wrong_pybullet(f"it does not export {name}") from None
    function.restype = result
    function.argtypes = arguments
    return function


_path = library_path()
WORK = ctypes.CDLL(_path)  # for calls that do real work
CHEAP = ctypes.PyDLL(_path)  # for those that take less time than the GIL's handover
