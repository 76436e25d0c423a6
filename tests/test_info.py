"""``python -m torch_panda info``."""

import re

import torch_panda
from torch_panda.__main__ import main
from torch_panda.info import stepping


def test_names_the_loop(loop):
    assert stepping().startswith(f"{loop}: ")


def test_names_versions_ids_and_spaces(capsys):
    main(["info"])
    output = capsys.readouterr().out
    assert re.search(r"pybullet 3\.\d", output)
    assert "cores usable" in output
    assert "TinyRenderer" in output
    push = "PandaPush{-v1,-v3,Dense-v1,Dense-v3}"
    assert f"{push}: observation 18, goal 3, action 3 in [-1, 1], 50 steps" in output
    named = [
        family + suffix
        for family, suffixes in re.findall(r"(\w+)\{(.*?)\}", output)
        for suffix in suffixes.split(",")
    ]
    assert sorted(named) == sorted(torch_panda.ENV_IDS)
