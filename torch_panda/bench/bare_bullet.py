"""Bullet alone, driven from C: the limit of what Python can reach on its threads."""

import ctypes
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from torch_panda.bullet._capi import library_path
from torch_panda.bullet.client import find_urdf

SOURCE = Path(__file__).with_suffix(".c")
URDF = "franka_panda/panda.urdf"

# (num_envs, num_threads, steps) to the steps per second of all environments.
BareBullet = Callable[[int, int, int], float]


def is_available() -> bool:
    """Whether this machine can link C code against pybullet's extension module."""
    return sys.platform == "linux" and shutil.which("cc") is not None


def load_bare_bullet(directory: str | Path) -> BareBullet:
    """Compile the C file in a directory, and load it.

    Raises:
        subprocess.CalledProcessError: the compiler failed.
    """
    output = Path(directory) / "bare_bullet.so"
    flags = ("-O2", "-std=c99", "-D_POSIX_C_SOURCE=200809L", "-shared", "-fPIC")
    files = (str(SOURCE), library_path(), "-o", str(output))
    subprocess.run(("cc", *flags, *files, "-lpthread"), check=True)
    function = ctypes.CDLL(str(output)).bare_bullet
    function.restype = ctypes.c_double
    path = find_urdf(URDF).encode()

    def run(num_envs: int, num_threads: int, steps: int) -> float:
        return float(function(path, num_envs, num_threads, steps))

    return run
