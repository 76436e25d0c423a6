"""Methods that only copy numbers of the state, so that C code can do their work."""

from collections.abc import Callable
from typing import TypeVar
from weakref import WeakSet

import torch
from torch import Tensor

from torch_panda.bullet.simulation import VectorSimulation

_Function = TypeVar("_Function", bound=Callable[..., Tensor])

_selectors: WeakSet[Callable[..., Tensor]] = WeakSet()


def selects_state(function: _Function) -> _Function:
    """Declare that a method of a task or robot only copies numbers of the state.

    Each number of its result must be a number of ``simulation.state``, from the same
    place in every call and every environment. The compiled library then copies these
    numbers instead of calling the method, which saves time. An override in a subclass
    is called as usual, unless it is declared too.
    """
    _selectors.add(function)
    return function


def selected_columns(
    method: Callable[[VectorSimulation], Tensor], simulation: VectorSimulation
) -> tuple[int, ...] | None:
    """Columns of ``simulation.state.rows`` that a method selects.

    Returns:
        None if the method is not declared by `selects_state`.

    Raises:
        ValueError: The method is declared, but does not copy numbers of the state.
    """
    if getattr(method, "__func__", method) not in _selectors:
        return None
    rows = simulation.state.rows
    saved = rows.clone()
    # Replace each number of the state by its index, and see which indices are returned.
    numbers = torch.arange(rows.numel(), dtype=rows.dtype, device="cpu").view_as(rows)
    try:
        rows.copy_(numbers)
        selected = method(simulation).clone()
    finally:
        rows.copy_(saved)
    columns = selected[0].tolist()
    is_valid = set(columns) <= set(numbers[0].tolist())
    if not is_valid or not numbers[:, list(map(int, columns))].equal(selected):
        raise ValueError(
            f"{method} is declared by selects_state, so it must return numbers of the "
            f"state, the same for all environments: remove the declaration"
        )
    return tuple(map(int, columns))
