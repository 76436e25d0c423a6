"""Trained policies that ship with the package; see its README."""

from pathlib import Path

FOLDER = Path(__file__).parent


def shipped_policies() -> dict[str, Path]:
    """The files of the policies by the id of their environment."""
    return {path.stem: path for path in sorted(FOLDER.glob("*.pt"))}
