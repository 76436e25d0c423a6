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

import tomllib

ROOT = Path(__file__).parent.parent
COPIED = ("torch_panda", "transforms", "examples", "tests", "pyproject.toml")
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


def mutate(mutation: dict[str, str], folder: Path) -> str:
    """Make one fault in the copy, run its test, and mend the fault again.

    Returns:
        "caught", or the reason why the entry is wrong.
    """
    path = folder / mutation["file"]
    text = path.read_text()
    if text.count(mutation["old"]) != 1:
        return f"{text.count(mutation['old'])} places have the text `old`, need one"
    env = {**os.environ, "PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1"}
    build = [sys.executable, "-c", BUILD, "-q", "build_ext", "--inplace"]
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-m", "", "-n", "0"]
    path.write_text(text.replace(mutation["old"], mutation["new"]))
    try:
        if path.suffix in (".c", ".h"):
            subprocess.run(build, cwd=folder, env=env, check=True, capture_output=True)
        done = subprocess.run(
            [*command, *mutation["caught_by"].split()],
            cwd=folder,
            env=env,
            capture_output=True,
            text=True,
        )
    finally:
        path.write_text(text)
        if path.suffix in (".c", ".h"):
            subprocess.run(build, cwd=folder, env=env, check=True, capture_output=True)
    if done.returncode == 1 and " failed" in done.stdout:
        return "caught"
    return "SURVIVED" if done.returncode == 0 else done.stdout[-2000:] + done.stderr


def main() -> None:
    """Make every listed fault, and exit with 1 if a test misses its fault."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "folders", nargs="*", help="folders below tests/; none means all"
    )
    mutations = read_mutations(parser.parse_args().folders)
    missed = 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        copy_checkout(folder)
        for mutation in mutations:
            result = mutate(mutation, folder)
            missed += result != "caught"
            print(f"{result}: {mutation['file']}: {mutation['fault']}", flush=True)
    print(f"{len(mutations) - missed} of {len(mutations)} faults caught")
    sys.exit(bool(missed))


if __name__ == "__main__":
    main()
