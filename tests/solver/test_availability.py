"""The packed solver must run where pybullet has a wheel, or its tests are skipped."""

import platform
import sys

import pytest

from torch_panda.bullet.solver import SolverStatus, activate, compat

HAS_WHEEL = (sys.platform, platform.machine(), sys.version_info[:2]) == (
    "linux",
    "x86_64",
    (3, 11),
)


@pytest.mark.skipif(not HAS_WHEEL, reason="pybullet has no wheel here")
@pytest.mark.skipif(not compat._LIBRARY.is_file(), reason="it is not compiled")
def test_the_packed_solver_runs_with_the_wheel_of_pybullet():
    assert activate() == SolverStatus("packed")
