"""MkDocs hook that adds the registered tasks, robots and sensors to their pages.

A page names them with ``{{ tasks }}``, ``{{ robots }}`` or ``{{ sensors }}``, which
becomes one section for each class.
"""

import torch_panda
from torch_panda.registry import FAMILIES
from torch_panda.sensors import SENSORS

CLASSES: dict[str, list[type]] = {
    "tasks": [family.task for family in FAMILIES],
    "robots": [family.robot for family in FAMILIES],
    "sensors": [type(sensor) for sensor in SENSORS.values()],
}


def on_page_markdown(markdown: str, **_: object) -> str:
    """Replace the placeholders of a page."""
    for name, classes in CLASSES.items():
        sections = "\n\n".join(f"::: {_path(item)}" for item in dict.fromkeys(classes))
        markdown = markdown.replace(f"{{{{ {name} }}}}", sections)
    return markdown


def _path(item: type) -> str:
    """Import path of a class, the short one if there is one."""
    if item.__name__ in torch_panda.__all__:
        return f"torch_panda.{item.__name__}"
    return f"{item.__module__}.{item.__name__}"
