"""The commands of the guide to data sets lead from data to a policy and its video."""

import re
import shlex
from pathlib import Path

import imageio.v3 as iio
import pytest

from torch_panda import commands

ROOT = Path(__file__).parents[1]
GUIDE = ROOT / "torch_panda" / "datasets" / "README.md"
# In place of the sizes of the guide, which take hours.
SMALL = {"--transitions": "200", "--total-steps": "20", "--episodes": "5"}


def read_commands():
    """The arguments of each command of the section."""
    section = GUIDE.read_text().split("\n## From data to a policy\n")[1]
    block = re.search(r"```bash\n(.*?)```", section, re.DOTALL)[1]
    lines = block.replace("\\\n", " ").strip().splitlines()
    arguments = [shlex.split(line, comments=True) for line in lines]
    assert all(words[:3] == ["python", "-m", "torch_panda"] for words in arguments)
    return [words[3:] for words in arguments]


@pytest.mark.usefixtures("quick")
def test_the_commands_of_the_guide_lead_to_the_video_of_a_policy(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    for words in read_commands():
        for option, size in SMALL.items():
            if option in words:
                words[words.index(option) + 1] = size
        commands.main(words)
    printed = capsys.readouterr().out
    assert re.search(r"sha256 [0-9a-f]{64}", printed)
    assert "success of very_far" in printed
    assert len(iio.imread(tmp_path / "runs" / "hiql" / "video.mp4")) == 51
