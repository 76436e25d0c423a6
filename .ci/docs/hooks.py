"""MkDocs hooks: guides, a page per task, registered classes, and ``llms.txt``."""

import re
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path

from jinja2 import Environment
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from task_pages import draw_picture, families, write_page

import torch_panda
from torch_panda.registry import FAMILIES
from torch_panda.sensors import SENSORS

ROOT = Path(__file__).parents[2]
CLASSES: dict[str, list[type]] = {
    "tasks": [family.task for family in FAMILIES],
    "robots": [family.robot for family in FAMILIES],
    "sensors": [type(sensor) for sensor in SENSORS.values()],
}


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """List the pages of the tasks."""
    pages = [{name: f"tasks/{name}.md"} for name in families()]
    config.nav.insert(2, {"Tasks": pages})
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the guides under ``guides/`` and the pages of the tasks under ``tasks/``.

    The files to which guides link are added, too.

    Relative links between guides stay valid, because the folders are kept.
    """
    for path in sorted(guide_files()):
        name = f"guides/{path.relative_to(ROOT)}"
        files.append(File.generated(config, name, abs_src_path=str(path)))
    for name in families():
        page, picture = f"tasks/{name}.md", f"tasks/{name}.webp"
        files.append(File.generated(config, page, content=write_page(name)))
        files.append(File.generated(config, picture, content=draw_picture(name)))
    return files


def guide_files() -> set[Path]:
    """The Markdown files outside this folder, and the files to which they link."""
    listed = subprocess.run(
        ["git", "ls-files", "*.md", ":!.ci"],
        cwd=ROOT,
        check=True,
        capture_output=True,
        text=True,
    ).stdout.split()
    guides = {ROOT / name for name in listed}
    linked = set()
    for guide in guides:
        for link in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", guide.read_text()):
            path = (guide.parent / link).resolve()
            if path.is_file():
                linked.add(path)
    return guides | linked


def on_page_markdown(markdown: str, **_: object) -> str:
    """Replace ``{{ tasks }}``, ``{{ robots }}`` and ``{{ sensors }}`` by sections.

    There is one section for each registered class. ``{{ task_pages }}`` becomes links.
    """
    links = ", ".join(f"[{name}](tasks/{name}.md)" for name in families())
    markdown = markdown.replace("{{ task_pages }}", links)
    for name, classes in CLASSES.items():
        sections = "\n\n".join(f"::: {_path(item)}" for item in dict.fromkeys(classes))
        markdown = markdown.replace(f"{{{{ {name} }}}}", sections)
    return markdown


def on_env(env: Environment, config: MkDocsConfig, files: Files) -> Environment:
    """Add ``llms.txt``, the list of pages for language models (llmstxt.org)."""
    pages = {file.src_uri: file.page.markdown for file in files.documentation_pages()}
    text = list_pages(config.nav, pages)
    files.append(File.generated(config, "llms.txt", content=text))
    return env


def list_pages(nav: Sequence[dict], pages: Mapping[str, str]) -> str:
    """Links to all pages in the order of the navigation, with their first sentences.

    Args:
        nav: The navigation: titles with the path of a page, or with such a list.
        pages: The Markdown of each page by its path.
    """
    lines = ["# torch_panda", "", f"> {_first_sentence(pages['index.md'])}"]
    for title, content in (pair for entry in nav for pair in entry.items()):
        lines += ["", f"## {title}", ""]
        entries = [{title: content}] if isinstance(content, str) else content
        for name, path in (pair for entry in entries for pair in entry.items()):
            url = path.replace("README.md", "index.html").replace(".md", ".html")
            text = _first_sentence(pages[path])
            lines.append(f"- [{name}]({url})" + (f": {text}" if text else ""))
    return "\n".join(lines) + "\n"


def _first_sentence(markdown: str) -> str:
    """The first sentence of a page, in one line without links."""
    for paragraph in markdown.split("\n\n"):
        if not re.match(r"\s*(#|!|\||:::|```|- )", paragraph):
            text = re.sub(r"\[([^]]+)\]\([^)]+\)", r"\1", " ".join(paragraph.split()))
            return re.split(r"(?<=\.) ", text)[0]
    return ""


def _path(item: type) -> str:
    """Import path of a class, the short one if there is one."""
    if item.__name__ in torch_panda.__all__:
        return f"torch_panda.{item.__name__}"
    return f"{item.__module__}.{item.__name__}"
