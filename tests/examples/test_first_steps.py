"""The first script of a newcomer learns Reach, and it is short."""

import subprocess
import sys
from pathlib import Path

import pytest

FILE = Path(__file__).parents[2] / "examples" / "first_steps.py"


@pytest.mark.timeout(600)
def test_it_learns_reach():
    run = subprocess.run(
        [sys.executable, FILE], check=True, capture_output=True, text=True
    )
    lines = [line for line in run.stdout.splitlines() if "steps: success" in line]
    assert lines[-1] == "2400 steps: success at the end of 50 episodes 100%"
    assert lines[0].startswith("400 steps")


def test_it_is_short():
    assert len(FILE.read_text().splitlines()) <= 60
