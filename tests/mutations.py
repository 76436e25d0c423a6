"""Check that tests fail when the code that they guard is wrong.

    python -m tests.mutations                # all folders
    python -m tests.mutations transforms     # one folder

Each ``mutations.toml`` below ``tests/`` lists faults that a user would notice. An entry
replaces one piece of text in one file and names a test that must fail then. The faults
are made in a copy of the checkout, one at a time. ``slow`` tests may be named, too.
Needs Python 3.11, for tomllib.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
import tomllib
import torchrl.collectors
import torchrl.data
import torchrl.objectives  # noqa: F401 (for the forks)

ROOT = Path(__file__).parent.parent
COPIED = ("torch_panda", "transforms", "examples", "tests", ".ci")
COPIED += ("pyproject.toml", "README.md")
BUILD = "from setuptools import setup; setup()"


def read_mutations(folders: list[str]) -> list[dict[str, str]]:
    """Entries of the ``mutations.toml`` of these folders, or of all folders."""
    tests = ROOT / "tests"
    paths = [tests / folder / "mutations.toml" for folder in folders]
    mutations = []
    for path in paths or sorted(tests.rglob("mutations.toml")):
        mutations += tomllib.loads(path.read_text())["mutation"]
    return mutations


def copy_checkout(folder: Path) -> None:
    """Copy the files that tests need, with the built libraries."""
    ignore = shutil.ignore_patterns("__pycache__")
    for name in COPIED:
        source, target = ROOT / name, folder / name
        if source.is_dir():
            shutil.copytree(source, target, symlinks=True, ignore=ignore)
        else:
            shutil.copy(source, target)


def run_tests(names: list[str], folder: Path, log: Path) -> int:
    """Run tests of the copy in a forked process, and return pytest's exit code.

    The fork has already imported the libraries, which takes several seconds. The
    package itself is imported from the copy.
    """
    child = os.fork()
    if child:
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    for name in [x for x in sys.modules if x.split(".")[0] == "tests"]:
        del sys.modules[name]
    os.chdir(folder)
    sys.path.insert(0, str(folder))
    sys.dont_write_bytecode = True
    os.environ |= {"PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1"}
    output = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(output, 1)
    os.dup2(output, 2)
    code = 3
    try:
        options = ["-q", "-x", "-m", "", "-n", "0", "-p", "no:cacheprovider"]
        code = int(pytest.main([*options, *names]))
    finally:
        sys.stdout.flush()
        os._exit(code)


def mutate(mutation: dict[str, str], folder: Path) -> str:
    """Make one fault in the copy, run its test, and mend the fault again.

    Returns:
        "caught", "skipped" if the test needs a library that is not installed, or the
        reason why the entry is wrong.
    """
    path, log = folder / mutation["file"], folder / "log.txt"
    text = path.read_text()
    if text.count(mutation["old"]) != 1:
        return f"{text.count(mutation['old'])} places have the text `old`, need one"
    path.write_text(text.replace(mutation["old"], mutation["new"]))
    try:
        build(path, folder)
        code = run_tests(mutation["caught_by"].split(), folder, log)
    finally:
        path.write_text(text)
        build(path, folder)
    output = log.read_text()
    if code == pytest.ExitCode.TESTS_FAILED and " failed" in output:
        return "caught"
    if " skipped" in output and " passed" not in output:
        return "skipped"
    return "SURVIVED" if code == pytest.ExitCode.OK else output[-2000:]


def build(path: Path, folder: Path) -> None:
    """Build the libraries of the copy, if a file in C has changed."""
    if path.suffix in (".c", ".h"):
        command = [sys.executable, "-c", BUILD, "-q", "build_ext", "--inplace"]
        subprocess.run(command, cwd=folder, check=True, capture_output=True)


def main() -> None:
    """Make every listed fault, and exit with 1 if a test misses its fault."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "folders", nargs="*", help="folders below tests/; none means all"
    )
    mutations = read_mutations(parser.parse_args().folders)
    results = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        copy_checkout(folder)
        for mutation in mutations:
            result = mutate(mutation, folder)
            results.append(result)
            print(f"{result}: {mutation['file']}: {mutation['fault']}", flush=True)
    caught, skipped = results.count("caught"), results.count("skipped")
    print(f"{caught} of {len(results)} faults caught, {skipped} skipped")
    sys.exit(caught + skipped < len(results))


if __name__ == "__main__":
    main()
