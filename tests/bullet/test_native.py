"""The compiled loop: its version, and what happens without it."""

import hashlib
import re
import shutil
import subprocess
import warnings
from pathlib import Path

import pytest

import torch_panda
from torch_panda.bullet import native

FOLDER = Path(native.__file__).parent
SOURCES = ("client.h", "client.c", "loop.c", "reset.c")
# Hash of the C sources without comments and white space, by version.
HASHES = {6: "9d95ef388a475e47"}


def hash_of_sources():
    code = "".join((FOLDER / name).read_text() for name in SOURCES)
    code = re.sub(r"/\*.*?\*/|\s", "", code, flags=re.DOTALL)
    return hashlib.sha256(code.encode()).hexdigest()[:16]


@pytest.fixture
def unset(monkeypatch):
    """Unset the environment variable, and forget that a warning was given."""
    monkeypatch.delenv(native.LOOP_VARIABLE, raising=False)
    native._warn_of_slow_loop.cache_clear()
    yield
    native._warn_of_slow_loop.cache_clear()


def test_the_version_belongs_to_the_sources():
    assert HASHES[native.VERSION] == hash_of_sources(), (
        "the C sources have changed: increase LOOP_VERSION in client.h and VERSION in "
        "native.py, and replace HASHES by the new version with the new hash"
    )
    header = (FOLDER / "client.h").read_text()
    assert f"LOOP_VERSION = {native.VERSION} }}" in header


@pytest.mark.skipif(native.LIBRARY is None, reason="there is no compiled loop")
@pytest.mark.parametrize("variable", [None, "", "native"])
def test_a_library_of_another_version_is_refused(unset, monkeypatch, variable):
    if variable is not None:
        monkeypatch.setenv(native.LOOP_VARIABLE, variable)
    monkeypatch.setattr(native, "VERSION", native.VERSION + 1)
    message = r"loop .*_loop.*\.so has version \d+, .* Compile it again: pip install "
    with pytest.raises(ImportError, match=message):
        torch_panda.make("PandaReach-v1")
    monkeypatch.setenv(native.LOOP_VARIABLE, "ctypes")
    with torch_panda.make("PandaReach-v1") as env:
        env.rollout(2)


@pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")
def test_a_library_from_before_the_version_numbers_has_version_0(tmp_path):
    source, library = tmp_path / "old.c", tmp_path / "old.so"
    source.write_text("int loop_create(void) { return 0; }")
    subprocess.run(["cc", "-shared", "-fPIC", "-o", library, source], check=True)
    assert native.Library(str(library)).version == 0


def missing(monkeypatch):
    monkeypatch.setattr(native, "LIBRARY", None)
    monkeypatch.setattr(native, "_reason_missing", "a test took it away")


@pytest.mark.parametrize("variable", [None, ""])
def test_a_missing_loop_warns_once(unset, monkeypatch, variable):
    if variable is not None:
        monkeypatch.setenv(native.LOOP_VARIABLE, variable)
    missing(monkeypatch)
    message = "1.5 times as long .* a test took it away.* pip install "
    with pytest.warns(RuntimeWarning, match=message) as caught:
        for _ in range(2):
            with torch_panda.make("PandaReach-v1") as env:
                assert env.episodes.simulation._native is None
    assert len(caught) == 1


def test_the_python_loop_that_was_asked_for_is_silent(unset, monkeypatch):
    missing(monkeypatch)
    monkeypatch.setenv(native.LOOP_VARIABLE, "ctypes")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        torch_panda.make("PandaReach-v1").close()


def test_a_missing_loop_that_was_asked_for_is_refused(unset, monkeypatch):
    missing(monkeypatch)
    monkeypatch.setenv(native.LOOP_VARIABLE, "native")
    with pytest.raises(ValueError, match="=native, but torch_panda has no compiled"):
        torch_panda.make("PandaReach-v1")


def test_an_unknown_loop_is_refused(monkeypatch):
    monkeypatch.setenv(native.LOOP_VARIABLE, "fortran")
    with pytest.raises(ValueError, match=r"one of \('native', 'ctypes'\) .*'fortran'"):
        torch_panda.make("PandaReach-v1")


def test_load_says_why_there_is_no_library(monkeypatch, tmp_path):
    monkeypatch.setattr(native.importlib.util, "find_spec", lambda name: None)
    assert "_loop*.so does not exist" in native.load()
    monkeypatch.setattr(native.shutil, "which", lambda name: None)
    assert "no C compiler" in native.load()
    broken = tmp_path / "_loop.so"
    broken.write_bytes(b"no library")

    class Spec:
        origin = str(broken)

    monkeypatch.setattr(native.importlib.util, "find_spec", lambda name: Spec)
    assert native.load().startswith("it cannot be loaded (")
