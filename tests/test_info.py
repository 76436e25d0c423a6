"""``python -m torch_panda info``."""

import re
from pathlib import Path

import torch_panda
from torch_panda import info
from torch_panda.__main__ import main
from torch_panda.extras import EXTRAS
from torch_panda.info import stepping

ROOT = Path(__file__).parents[1]


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


def test_says_how_to_get_what_is_missing(monkeypatch):
    monkeypatch.setattr(info, "find_spec", lambda name: None)
    monkeypatch.setattr(info, "loop_problem", lambda: "there is no C compiler")
    monkeypatch.delenv("DISPLAY", raising=False)
    extras = "\n".join(info.extras())
    assert "pip install 'torch_panda[viewer]'" in extras
    monkeypatch.setattr(info.sys, "version_info", (3, 10))
    assert "Minari's format): missing: needs Python 3.11" in "\n".join(info.extras())
    missing = "\n".join(info.missing())
    assert "C compiler" in missing
    assert "egl" in missing


def test_knows_the_extras():
    """Those for users; `test` and `docs` are for who changes the package."""
    text = (ROOT / "pyproject.toml").read_text()
    section = text.split("[project.optional-dependencies]")[1].split(
        "\n[project.scripts]"
    )[0]
    declared = set(re.findall(r"^(\w+) = ", section, re.MULTILINE))
    declared -= {"test", "docs", "examples"}  # `examples` is `learning`, renamed
    assert declared == set(EXTRAS)
