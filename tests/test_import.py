"""What `import torch_panda` does, and in which direction its rooms import."""

import ast
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest

import torch_panda

PACKAGE = Path(torch_panda.__file__).parent
# Rooms from the ground up: each imports from those above it in this list.
ROOMS = (
    ("arguments", "checks", "rotations"),
    ("bullet",),
    ("rendering", "robots", "tasks"),
    ("sensors",),
    ("envs",),
    ("noise",),
    ("registry",),
    ("gymnasium_envs",),
)
HEIGHT = {room: height for height, rooms in enumerate(ROOMS) for room in rooms}

IMPORT = """
import sys, time, warnings
import torchrl, torchrl.envs, torchrl.data, gymnasium
filters, before = list(warnings.filters), time.process_time()
import torch_panda
print(time.process_time() - before)
assert warnings.filters == filters
assert "torch_panda/PandaPush-v1" in gymnasium.registry
for module in ("pybullet", "torch_panda.gymnasium_envs", "torch_panda.commands.bench"):
    assert module not in sys.modules, module
"""


def test_importing_registers_ids_and_is_cheap():
    """At most 0.3 s of CPU time beyond torchrl's, no warnings filter, no output."""
    seconds = []
    for _ in range(2):
        done = subprocess.run(
            [sys.executable, "-c", IMPORT], capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr
        seconds.append(float(done.stdout))
    assert min(seconds) < 0.3


def test_the_version_is_that_of_the_installed_package():
    assert torch_panda.__version__ == version("torch_panda")


def imported_rooms(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom):
            parts = (node.module or "").split(".")
            if parts[0] == "torch_panda" and len(parts) > 1:
                yield parts[1]


@pytest.mark.parametrize("room", HEIGHT)
def test_imports_point_down(room):
    folder = PACKAGE / room
    files = folder.glob("*.py") if folder.is_dir() else [folder.with_suffix(".py")]
    for file in files:
        for other in imported_rooms(file):
            assert other == room or HEIGHT[other] < HEIGHT[room], (file.name, other)


def test_the_core_needs_no_torchrl():
    """Only the interface of the environments imports torchrl."""
    interface = {"robot_task.py", "specs.py", "state_transform.py"}
    for room in ("bullet", "rendering", "robots", "tasks", "sensors", "envs"):
        for file in (PACKAGE / room).glob("*.py"):
            text = file.read_text()
            uses = "from torchrl" in text or "import torchrl" in text
            assert not uses or (room == "envs" and file.name in interface), file
