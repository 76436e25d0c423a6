"""What the ids -v1 and -v3 are made of, side by side.

``-v1`` is the world of the paper (Gallouédec et al. 2021, arXiv 2106.13687, June 2021)
and, where it gives no number, of panda-gym 1.1.0 (29 June 2021), the release of its
month, whose ids these are. ``-v3`` is panda-gym 3.0.7 (2023). A pair is (-v1, -v3);
a task's argument has the first by default.

Lateral friction of a contact is the product of both bodies'. Bullet's own is 0.5, which
panda-gym 3.0.7 leaves where it sets none. Flip came after 1.1.0: its -v1 has 3.0.7's
cube and fingers on the -v1 table.
"""

from types import MappingProxyType
from typing import Any

from torch_panda.bullet.shapes import BLUE, RED

# Arguments in which the versions differ, and those that panda-gym 1.1.0 settles.
Pairs = MappingProxyType[str, tuple[Any, Any]]


def _pairs(**arguments: tuple[Any, Any]) -> Pairs:
    return MappingProxyType(arguments)


TASK_ARGUMENTS: dict[str, Pairs] = {
    "Reach": _pairs(
        table_friction=(0.1, 0.5),
    ),
    "Push": _pairs(
        table_friction=(0.1, 0.5),
        object_mass=(2.0, 1.0),  # [kg]
        object_friction=(0.5, 0.5),
    ),
    "Slide": _pairs(
        table_friction=(0.1, 0.5),
        object_mass=(2.0, 1.0),  # [kg]
        object_friction=(0.5, 0.04),
        # The paper's goals, out of the arm's reach, and a table long enough for them;
        # panda-gym 1.1.0 has 3.0.7's.
        goal_xy_range=(0.5, 0.3),  # [m]
        goal_x_offset=(0.51, 0.4),  # [m]
        table_length=(1.9, 1.4),  # [m]
        table_x_offset=(0.15, -0.1),  # [m]
    ),
    "PickAndPlace": _pairs(
        table_friction=(0.1, 0.5),
        object_mass=(2.0, 1.0),  # [kg]
        object_friction=(5.0, 0.5),
    ),
    "Stack": _pairs(
        table_friction=(0.1, 0.5),
        object_mass=((2.0, 2.0), (2.0, 1.0)),  # lower and upper cube [kg]
        object_friction=(5.0, 0.5),
        # The paper's success, and panda-gym's in both releases: 6-d distance < 0.1.
        distance_threshold=(0.05, 0.1),  # [m]
        per_object=(True, False),
        lower_color=(RED, BLUE),
    ),
    "Flip": _pairs(
        table_friction=(0.1, 0.5),
        object_mass=(1.0, 1.0),  # [kg]
        object_friction=(0.5, 0.5),
    ),
}

# Of the fingers. None: the URDF's own, 0.1.
_SPINNING = (None, 0.001)
ROBOT_ARGUMENTS: dict[str, Pairs] = {
    "Reach": _pairs(finger_friction=(1.0, 1.0), finger_spinning_friction=_SPINNING),
    "Push": _pairs(finger_friction=(1.0, 1.0), finger_spinning_friction=_SPINNING),
    "Slide": _pairs(finger_friction=(1.0, 1.0), finger_spinning_friction=_SPINNING),
    "PickAndPlace": _pairs(
        finger_friction=(5.0, 1.0), finger_spinning_friction=_SPINNING
    ),
    "Stack": _pairs(finger_friction=(5.0, 1.0), finger_spinning_friction=_SPINNING),
    "Flip": _pairs(finger_friction=(1.0, 1.0), finger_spinning_friction=(0.001, 0.001)),
}

VERSIONS = ("v1", "v3")

# Of a task that is the same in both.
NO_PAIRS = _pairs()


def arguments_of(pairs: Pairs, version: str) -> dict[str, Any]:
    """One version's values of some arguments."""
    column = VERSIONS.index(version)
    return {name: pair[column] for name, pair in pairs.items()}
