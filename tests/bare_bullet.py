"""Bullet alone, driven from C: compile bare_bullet.c, run it, print its steps/s.

python tests/bare_bullet.py [num_envs [num_threads [steps]]]
"""

import ctypes
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from torch_panda.bullet._capi import library_path
from torch_panda.bullet.client import find_urdf

SOURCE = Path(__file__).with_suffix(".c")
URDF = "franka_panda/panda.urdf"


def is_available():
    """Whether this machine can link C code against pybullet's extension module."""
    return sys.platform == "linux" and shutil.which("cc") is not None


def load_bare_bullet(directory):
    """Compile the C file in a directory; (num_envs, num_threads, steps) to steps/s."""
    output = Path(directory) / "bare_bullet.so"
    flags = ("-O2", "-std=c99", "-D_POSIX_C_SOURCE=200809L", "-shared", "-fPIC")
    files = (str(SOURCE), library_path(), "-o", str(output))
    subprocess.run(("cc", *flags, *files, "-lpthread"), check=True)
    function = ctypes.CDLL(str(output)).bare_bullet
    function.restype = ctypes.c_double
    path = find_urdf(URDF).encode()
    return lambda num_envs, num_threads, steps: function(
        path, num_envs, num_threads, steps
    )


def main():
    given = [int(number) for number in sys.argv[1:]]
    num_envs, num_threads, steps = given + [16, 2, 200][len(given) :]
    with tempfile.TemporaryDirectory() as directory:
        steps_per_second = load_bare_bullet(directory)(num_envs, num_threads, steps)
    print(f"{steps_per_second:.1f}")


if __name__ == "__main__":
    main()
