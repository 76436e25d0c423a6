"""Finds and loads Bullet: the extension module that pybullet's wheel installs.

ctypes loads the module twice, because the class of a ctypes library decides whether its
functions release the GIL:

* ``CDLL`` releases the GIL during a call. It serves calls that take long, such as time
  steps, so that threads can step different clients at the same time.
* ``PyDLL`` keeps the GIL. It serves cheap calls, such as setters: releasing the GIL
  would take longer than the call, and two threads would pass it back and forth.

Python does not import the module, because importing pybullet prints a line.
"""

import ctypes
import importlib.metadata
import importlib.util
from typing import Any

SUPPORTED_VERSION = "3.2.7"


def wrong_pybullet(reason: str) -> ImportError:
    """The error for a pybullet whose C API differs from the one declared in `capi`."""
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
    """Path of a module that pybullet installs, without importing it.

    Raises:
        ImportError: pybullet is not installed.
    """
    spec = importlib.util.find_spec(module)
    if spec is None or spec.origin is None:
        raise wrong_pybullet("pybullet is not installed")
    return spec.origin


def bind(library: ctypes.CDLL, name: str, result: Any, *arguments: Any) -> Any:  # noqa: ANN401 (ctypes function types)
    """Declare a C function with its name, its result type and its argument types.

    Raises:
        ImportError: The library does not export the name.
    """
    try:
        function = getattr(library, name)
    except AttributeError:
        raise wrong_pybullet(f"it does not export {name}") from None
    function.restype = result
    function.argtypes = arguments
    return function


_path = library_path()
WORK = ctypes.CDLL(_path)  # releases the GIL
CHEAP = ctypes.PyDLL(_path)  # keeps the GIL
