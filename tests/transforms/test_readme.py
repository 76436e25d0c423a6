"""The guide's snippets run."""

import re
from pathlib import Path

GUIDE = Path(__file__).parents[2] / "transforms" / "README.md"


def test_guide():
    """Its snippets run one after the other, as a reader would type them."""
    text = GUIDE.read_text()
    snippets = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    names = {}
    for snippet in snippets:
        exec(compile(snippet, str(GUIDE), "exec"), names)
    assert len(snippets) == 6
    assert names["slices"].shape == (50, 5)
    goals = names["slices"]["desired_goal"]
    assert (goals == goals[:, :1]).all()
    assert names["batch"].shape == (256,)
