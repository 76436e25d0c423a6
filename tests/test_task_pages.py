"""The page of each task in the documentation, which .ci/docs/task_pages.py writes."""

import io
import re

import pytest
import task_pages
from PIL import Image

import torch_panda
from torch_panda.policies import shipped_policies

TASKS = tuple(task_pages.families())


def read_section(page, title):
    return page.split(f"\n## {title}")[1].split("\n## ")[0]


def read_first_cells(text):
    return re.findall(r"^\| ([^|]*) \|", text, re.MULTILINE)


def count_entries(cells):
    """Number of entries of a table whose last row has "7", or "7:10"."""
    start, _, stop = cells[-1].partition(":")
    return int(stop or int(start) + 1)


@pytest.mark.parametrize("task", TASKS)
def test_the_entries_on_a_page_are_those_of_the_environment(task):
    page = task_pages.write_page(task)
    observation = read_first_cells(read_section(page, "Observation"))
    actions = read_section(page, "Action")
    for control, word in (("", "without"), ("Joints", "with")):
        with torch_panda.make(f"Panda{task}{control}-v1") as env:
            size = env.observation_spec["observation"].shape[-1]
            assert count_entries(observation) == size
            assert f"`observation`: {str(env.goal_indices)[1:-1]}." in page
            rows = re.findall(rf"^\| {word} `Joints` \| (\S+) ", actions, re.M)
            assert rows
            assert count_entries(rows) == env.action_spec.shape[-1]


@pytest.mark.parametrize("task", TASKS)
def test_a_page_has_the_success_and_the_training_of_every_policy(task):
    page = task_pages.write_page(task)
    policies = {x for x in shipped_policies() if re.fullmatch(f"Panda{task}-v.", x)}
    assert policies
    for title in ("Success", "Training"):
        cells = read_first_cells(read_section(page, title))
        assert {cell.strip("`") for cell in cells} >= policies


def test_a_page_has_the_options_that_version_3_changes():
    options = read_section(task_pages.write_page("Push"), "Options and versions")
    assert "| `object_mass` | Mass of the cube [kg]. | `2.0` | `1.0` |" in options
    assert (
        "| `goal_xy_range` | Edge length of the square of goals [m]. | `0.3` |  |"
        in options
    )
    assert "`finger_spinning_friction` of the robot" in options
    assert "`finger_friction` of the robot" not in options


def test_the_picture_of_a_task_shows_two_moments_of_an_episode(monkeypatch):
    monkeypatch.setattr(task_pages, "SIZE", (50, 60))
    picture = Image.open(io.BytesIO(task_pages.draw_picture("Reach")))
    assert picture.size == (120, 50)
    halves = [picture.crop((x, 0, x + 60, 50)).tobytes() for x in (0, 60)]
    assert halves[0] != halves[1]
