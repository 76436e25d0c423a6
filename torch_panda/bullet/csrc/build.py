"""Commands of setuptools with which pyproject.toml builds the package.

setuptools loads this file by its path, so it must not import torch_panda.
"""

import shutil
import zlib
from pathlib import Path

from setuptools.command.bdist_wheel import bdist_wheel
from setuptools.command.build_ext import build_ext

_SOURCES = Path(__file__).parent


class BuildLibraries(build_ext):
    """Compiles the libraries. `_loop` exports a hash of its sources for `loop.py`."""

    def build_extensions(self) -> None:
        """Stop with a clear message if there is no C compiler."""
        compiler = getattr(self.compiler, "compiler_so", ["cc"])[0]
        if shutil.which(compiler) is None:
            raise SystemExit(
                f"torch_panda needs a C compiler, and {compiler!r} is missing: install "
                "one, for example with `apt install gcc`, and install torch_panda again"
            )
        files = sorted((*_SOURCES.glob("*.c"), *_SOURCES.glob("*.h")))
        version = zlib.crc32(b"".join(file.read_bytes() for file in files))
        for extension in self.extensions:
            if extension.name == "torch_panda.bullet._loop":
                extension.define_macros.append(("LOOP_VERSION", f"{version}u"))
        super().build_extensions()


class Wheel(bdist_wheel):
    """Builds one wheel for all versions of Python 3, because no C file uses Python."""

    def get_tag(self) -> tuple[str, str, str]:
        """Tag of the wheel: Python, its binary interface, and the platform."""
        _, _, platform = super().get_tag()
        return "py3", "none", platform
