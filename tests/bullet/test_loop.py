"""The compiled loop: its version, and what happens without it."""

import shutil

import pytest

import torch_panda
from torch_panda import info
from torch_panda.bullet import loop
from torch_panda.bullet.csrc import write_functions


def test_the_header_declares_the_functions_of_the_table():
    assert write_functions.HEADER.read_text() == write_functions.header(), (
        "run python -m torch_panda.bullet.csrc.write_functions"
    )


@pytest.fixture
def unloaded():
    """Load the library again, as in a new process."""
    loop.load_library.cache_clear()
    yield
    loop.load_library.cache_clear()


def test_a_library_compiled_from_other_sources_is_refused(
    unloaded, monkeypatch, tmp_path
):
    sources = shutil.copytree(loop._SOURCES, tmp_path / "csrc")
    monkeypatch.setattr(loop, "_SOURCES", sources)
    torch_panda.make("PandaReach-v1").close()
    loop.load_library.cache_clear()
    (sources / "loop.c").write_text("int loop_version(void) { return 1; }")
    message = r"_loop.*\.so was compiled from other C files .* again: pip install "
    with pytest.raises(ImportError, match=message):
        torch_panda.make("PandaReach-v1")


def test_without_the_library_no_environment_is_made(unloaded, monkeypatch, tmp_path):
    monkeypatch.setattr(loop, "_LIBRARY", tmp_path / "_loop.abi3.so")
    message = r"cannot load its compiled loop \(.*_loop.* With a C compiler .* pip ins"
    with pytest.raises(ImportError, match=message):
        torch_panda.make("PandaReach-v1")
    assert info.environments() == ["none can be made, see missing"]
    assert "C compiler" in "\n".join(info.missing())
