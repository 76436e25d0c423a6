"""Names of the renderers, and tests whether they work on this machine."""

import functools
import subprocess
import sys
from typing import Literal, get_args

from torch_panda.checks import check_choice

# Bullet's software renderer, and its OpenGL renderer without a window.
RendererName = Literal["tiny", "egl"]

# Draws a box in front of the background and checks that the picture shows both. The
# code uses pybullet instead of this package, because importing torch takes much longer.
_EGL_PROBE = """
import importlib.util, numpy, pybullet as p
p.connect(p.DIRECT)
path = importlib.util.find_spec("eglRenderer").origin
assert p.loadPlugin(path, "_eglRendererPlugin") >= 0, "the plugin does not load"
p.createMultiBody(0, p.createCollisionShape(p.GEOM_BOX, halfExtents=[0.5] * 3))
view = p.computeViewMatrixFromYawPitchRoll([0] * 3, 3, 0, -30, 0, 2)
projection = p.computeProjectionMatrixFOV(60, 1.5, 0.1, 100)
_, _, rgba, depth, _ = p.getCameraImage(60, 40, view, projection)
assert numpy.std(rgba) > 1 and numpy.std(depth) > 0, "the image is blank"
"""


def check_renderer(renderer: str) -> None:
    """Make sure that a renderer works on this machine.

    Raises:
        ValueError: There is no renderer of this name.
        RuntimeError: EGL does not work on this machine.
    """
    check_choice("renderer", renderer, get_args(RendererName))
    if renderer == "egl":
        _check_egl()


@functools.cache
def _check_egl() -> None:
    # Try it in another process, because Bullet ends its process if EGL fails.
    if reason := probe(_EGL_PROBE):
        raise RuntimeError(
            f"renderer='egl' does not work on this machine: use 'tiny' ({reason})"
        )


def probe(code: str) -> str | None:
    """Run Python code in another process.

    Returns:
        None if the code succeeded, otherwise the last line of its output.
    """
    process = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True
    )
    if process.returncode == 0:
        return None
    output = (process.stdout + process.stderr).strip()
    return output.splitlines()[-1].strip() if output else "no output"
