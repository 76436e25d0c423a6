"""The command ``info``."""

import re
from pathlib import Path

import torch_panda
from torch_panda import info
from torch_panda.__main__ import main
from torch_panda.extras import EXTRAS

ROOT = Path(__file__).parents[1]


def test_the_text_has_versions_and_the_sizes_of_every_environment(capsys):
    main(["info"])
    output = capsys.readouterr().out
    assert re.search(r"pybullet 3\.\d", output)
    assert "default: one per core that this process may use" in output
    push = "PandaPush{-v1,-v3,Dense-v1,Dense-v3}"
    assert f"{push}: observation 18, goal 3, action 3 in [-1, 1], 50 steps" in output
    ids = [
        family + suffix
        for family, suffixes in re.findall(r"(\w+)\{(.*?)\}", output)
        for suffix in suffixes.split(",")
    ]
    assert sorted(ids) == sorted(torch_panda.ENV_IDS)


def test_the_text_says_how_to_install_missing_extras(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(info, "find_spec", lambda name: None)
    monkeypatch.delenv("DISPLAY", raising=False)
    extras = "\n".join(info.extras())
    assert f"pip install -e '{ROOT}[viewer]'" in extras
    monkeypatch.chdir(ROOT)
    assert "pip install -e '.[viewer]'" in "\n".join(info.extras())
    monkeypatch.setattr("torch_panda.extras._ROOT", Path("/usr/lib/python3"))
    assert "pip install 'torch_panda[viewer]'" in "\n".join(info.extras())
    monkeypatch.setattr(info.sys, "version_info", (3, 10))
    assert "Minari's format): missing: needs Python 3.11" in "\n".join(info.extras())
    missing = "\n".join(info.missing())
    assert "egl" in missing


def test_the_text_lists_every_extra():
    """`test` and `docs` are for developers, so `info` leaves them out."""
    text = (ROOT / "pyproject.toml").read_text()
    section = text.split("[project.optional-dependencies]")[1].split(
        "\n[project.scripts]"
    )[0]
    declared = set(re.findall(r"^(\w+) = ", section, re.MULTILINE))
    declared -= {"test", "docs"}
    assert declared == set(EXTRAS)
