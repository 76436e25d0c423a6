"""The script that checks gradient steps on a GPU, here without one."""

import os
import subprocess
import sys
from pathlib import Path

# A machine with a GPU may have torch and torchrl only.
CODE = """
import runpy, sys
from importlib.machinery import PathFinder

ABSENT = "pybullet gymnasium tyro tqdm matplotlib imageio filelock".split()

class Finder(PathFinder):
    @classmethod
    def find_spec(cls, name, path=None, target=None):
        if name.split(".")[0] not in ABSENT:
            return super().find_spec(name, path, target)

sys.meta_path = [Finder if x is PathFinder else x for x in sys.meta_path]
runpy.run_path(sys.argv[1], run_name="__main__")
"""


def test_the_check_runs_with_torch_and_torchrl_alone():
    script = Path(__file__).parents[2] / ".ci" / "gpu_check.py"
    done = subprocess.run(
        [sys.executable, "-c", CODE, script],
        env={**os.environ, "CUDA_VISIBLE_DEVICES": ""},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    algorithms = [row.split()[1] for row in done.stdout.splitlines() if row[:2] == "| "]
    compared = ["gcivl", "gciql-nstep", "hiql", "qrl", "gcbc"]
    online = ["ddpg", "td3", "sac"]
    assert algorithms == ["algorithm", *compared, *online, "algorithm", *compared]
