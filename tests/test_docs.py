"""The pages of the API reference, in .ci/docs."""

import importlib
import pkgutil
import re
from pathlib import Path

import pytest

import torch_panda

DOCS = Path(__file__).parents[1] / ".ci" / "docs"


def load_hooks():
    pytest.importorskip("mkdocs")
    return importlib.import_module("hooks")


def read_pages():
    """Text of every page by name, as the hook completes it."""
    hooks = load_hooks()
    pages = (DOCS / "pages").glob("*.md")
    return {page.name: hooks.on_page_markdown(page.read_text()) for page in pages}


def resolve(path):
    """Name and object of an import path such as "torch_panda.Camera"."""
    module, _, name = path.rpartition(".")
    return name, getattr(importlib.import_module(module), name)


def documented():
    """Name and object of every entry of the pages, with repetitions."""
    text = "\n".join(read_pages().values())
    return [resolve(path) for path in re.findall(r"^::: (\S+)", text, re.MULTILINE)]


def public_names():
    """Name and object of everything that a package exports in ``__all__``."""
    walk = pkgutil.walk_packages(torch_panda.__path__, "torch_panda.")
    packages = ["torch_panda", *(entry.name for entry in walk if entry.ispkg)]
    for package in packages:
        module = importlib.import_module(package)
        for name in getattr(module, "__all__", ()):
            yield name, getattr(module, name)


def count(entries, name, value):
    return sum(name == other and value is x for other, x in entries)


def test_every_public_name_is_on_exactly_one_page():
    entries = documented()
    counts = {name: count(entries, name, value) for name, value in public_names()}
    assert len(counts) > 50
    wrong = {name: number for name, number in counts.items() if number != 1}
    assert not wrong, "add the name to a page in .ci/docs/pages"


def test_the_list_for_language_models_has_every_page_with_its_first_sentence():
    nav = [{"Overview": "index.md"}, {"Guides": [{"Use": "guides/README.md"}]}]
    pages = {"index.md": "# Title\n\nIt steps\nrobots. It relabels."}
    pages["guides/README.md"] = (
        "![a](b.png)\n\nUse [the tasks](tasks.md) 1.5 times. No more."
    )
    assert load_hooks().list_pages(nav, pages).splitlines() == [
        "# torch_panda",
        "",
        "> It steps robots.",
        "",
        "## Overview",
        "",
        "- [Overview](index.html): It steps robots.",
        "",
        "## Guides",
        "",
        "- [Use](guides/index.html): Use the tasks 1.5 times.",
    ]


def test_links_of_guides_lead_to_files():
    """The built pages contain the files to which guides link, but no folders."""
    guides = [path for path in load_hooks().guide_files() if path.suffix == ".md"]
    links = [
        (guide, link)
        for guide in guides
        for link in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", guide.read_text())
    ]
    assert len(links) > 100
    assert [x for x in links if not (x[0].parent / x[1]).is_file()] == []
