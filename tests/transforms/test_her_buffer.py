"""The guide's scripts about torchrl's HERReplayBuffer fail as the guide says."""

import re
from pathlib import Path

import pytest
import torch

GUIDE = (Path(__file__).parents[2] / "transforms" / "README.md").read_text()
SETUP, *SCRIPTS = re.findall(r"```py\n(.*?)```", GUIDE, re.DOTALL)

ERRORS = {
    "mixes episodes": (AssertionError, "have a goal of another episode"),
    "goals before the step": (AssertionError, "the last goal is that of step 49 of 50"),
    "keeps ends": (AssertionError, "rows reach their new goals, 0 of them terminate"),
    "first rows": (AssertionError, r"\[1.0, 1.0, .*, 0.0, 0.0\]"),
    "two dimensions": (NotImplementedError, "only supports 1D storages"),
    "full buffer": (RuntimeError, "Boolean value of Tensor"),
}


def run(script):
    torch.manual_seed(0)
    names = {}
    exec(compile(SETUP, "setup", "exec"), names)
    exec(compile(script, "script", "exec"), names)


@pytest.mark.parametrize(
    ("script", "error", "message"),
    [(s, *e) for s, e in zip(SCRIPTS, ERRORS.values(), strict=True)],
    ids=[*ERRORS],
)
def test_a_script_about_torchrls_buffer_fails(script, error, message):
    """If one passes, torchrl has corrected its buffer: delete it from the guide."""
    with pytest.raises(error, match=message):
        run(script)
