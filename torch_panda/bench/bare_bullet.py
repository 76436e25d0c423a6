"""Bullet alone, driven from C: the limit of what Python can reach on its threads."""

import ctypes
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from torch_panda.bullet.library import library_path
from torch_panda.bullet.urdf import find_urdf

SOURCE = Path(__file__).with_suffix(".c")
URDF = "franka_panda/panda.urdf"


class Speed(NamedTuple):
    """Steps of all environments together, by two clocks.

    Attributes:
        per_second: steps per second.
        per_cpu_second: steps per second of processor time, of all processes; other
            work on the machine hardly changes it.
    """

    per_second: float
    per_cpu_second: float


# (num_envs, num_threads, steps of each) to the speed.
BareBullet = Callable[[int, int, int], Speed]


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
    function.restype = None
    path = find_urdf(URDF).encode()

    def run(num_envs: int, num_threads: int, steps: int) -> Speed:
        wall, cpu = ctypes.c_double(), ctypes.c_double()
        function(
            path, num_envs, num_threads, steps, ctypes.byref(wall), ctypes.byref(cpu)
        )
        count = num_envs * steps
        return Speed(count / wall.value, count / cpu.value)

    return run
