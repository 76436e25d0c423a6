"""The guides: their snippets run as they stand, and their tables are complete.

`mkdocs build --strict` checks their links.
"""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FOLDERS = ("", "torch_panda", "torch_panda/tasks", "transforms", "examples")
FOLDERS += ("torch_panda/policies", "examples/results", "torch_panda/gymnasium_envs")
FOLDERS += ("torch_panda/learning", "torch_panda/datasets")
PAGES = [page for folder in FOLDERS for page in (ROOT / folder).glob("*.md")]
GUIDES = sorted(str(page.relative_to(ROOT)) for page in PAGES)
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


def read_without_code(page):
    """The text of a page, without its code blocks."""
    pattern = r"^```.*?^```"
    return re.sub(pattern, "", page.read_text(), flags=re.DOTALL | re.MULTILINE)


def count_cells(page):
    """Number of cells of each row, one list for each table of a page."""
    tables = re.findall(r"(?:^\|.*\n?)+", read_without_code(page), re.MULTILINE)
    return [
        [len(re.findall(r"(?<!\\)\|", row)) - 1 for row in table.splitlines()]
        for table in tables
    ]


@pytest.mark.parametrize("name", GUIDES)
def test_rows_of_a_table_have_as_many_cells_as_its_header(name):
    tables = count_cells(ROOT / name)
    assert [rows for rows in tables if len(set(rows)) > 1] == []


def test_the_guides_own_task_is_the_script():
    guide = (ROOT / "torch_panda" / "README.md").read_text()
    section = guide.split("\n## Your own task\n")[1]
    blocks = re.findall(r"```python\n(.*?)```", section, re.DOTALL)
    (code,) = [block for block in blocks if "class PushBall(" in block]
    assert code in (ROOT / "examples" / "own_task.py").read_text()
