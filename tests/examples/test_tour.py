"""The notebook examples/tour.ipynb is short, and runs without Jupyter."""

import json
import tempfile
from pathlib import Path

import pytest

NOTEBOOK = Path(__file__).parents[2] / "examples" / "tour.ipynb"
CELLS = json.loads(NOTEBOOK.read_text())["cells"]
# In place of constants of the notebook.
SMALL = {
    "EPISODES = 64": "EPISODES = 2",
    '"1200"]': '"50", "--num-envs=1", "--updates-per-step=0.1", "--batch-size=64"]',
}
CODE = [cell for cell in CELLS if cell["cell_type"] == "code"]


def count_lines(output):
    """Number of lines of a stored output. A picture is one."""
    return len(output["text"]) if output["output_type"] == "stream" else 1


@pytest.mark.usefixtures("quick")
def test_the_code_cells_run_one_after_the_other(tmp_path, monkeypatch, capsys):
    """With few episodes, and a training that hardly begins."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    text = "".join(line for cell in CODE for line in cell["source"])
    assert all(text.count(old) == 1 for old in SMALL)
    names = {}
    for cell in CODE:
        source = "".join(cell["source"])
        for old, new in SMALL.items():
            source = source.replace(old, new)
        exec(compile(source, NOTEBOOK, "exec"), names)
    assert capsys.readouterr().out.count("of 2 episodes") == 2
    assert {x.name for x in names["folder"].iterdir()} == {"push.mp4", "reach"}


def test_the_notebook_has_few_cells_and_the_outputs_of_one_execution():
    assert len(CELLS) <= 15
    outputs = [output for cell in CODE for output in cell["outputs"]]
    assert 0 < sum(count_lines(output) for output in outputs) <= 40
    assert {x["output_type"] for x in outputs} <= {"stream", "execute_result"}
    assert [cell["execution_count"] for cell in CODE] == list(range(1, len(CODE) + 1))
