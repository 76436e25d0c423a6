"""The guides: their snippets run as they stand.

`mkdocs build --strict` checks their links.
"""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
MAX_LINES, MAX_WORDS = 150, 1_700


@pytest.mark.parametrize(
    "guide",
    [
        "README.md",
        "torch_panda/README.md",
        "transforms/README.md",
        "torch_panda/gymnasium_envs/README.md",
        "torch_panda/datasets/README.md",
    ],
)
def test_the_snippets_of_a_guide_run(guide):
    """One after the other, as a reader would type them."""
    snippets = re.findall(r"```python\n(.*?)```", (ROOT / guide).read_text(), re.DOTALL)
    assert snippets
    names = {}
    for snippet in snippets:
        exec(compile(snippet, guide, "exec"), names)


def test_the_readme_is_short():
    text = (ROOT / "README.md").read_text()
    assert len(text.splitlines()) <= MAX_LINES
    assert len(text.split()) <= MAX_WORDS
