"""Refuses states that torchrl's wrappers would drop on their way to an environment."""

import sys

from torchrl.envs import EnvBase, ParallelEnv, SerialEnv, TransformedEnv

from torch_panda.envs.state import BODY_KEYS, NESTED_STATE, has_nested_state

# torchrl's function that decides whether a reset starts from a state.
_RESOLVE_CODE = EnvBase._resolve_set_state.__code__


class StateSupport:
    """The answer of ``_supports_set_state``, whose truth test may raise an error.

    torchrl asks an environment whether its resets may start from a state. The wrappers
    `TransformedEnv`, `SerialEnv` and `ParallelEnv` give the answer of the environment
    that they wrap, even if it runs in another process.

    torchrl evaluates the answer as a boolean in every reset of a wrapper, before the
    wrapper passes the state on. `__bool__` uses this moment to raise an error if the
    state of this reset would not reach the environment. torchrl does not pass the
    arguments of the reset, so `__bool__` reads them from the calling function.

    Args:
        observed: Keys of the entries that the environment observes in addition to
            ``observation`` and the goals.
    """

    def __init__(self, observed: frozenset[str]) -> None:
        self._observed = observed

    def __bool__(self) -> bool:
        """Whether torchrl should look for a state in this reset.

        Raises:
            ValueError: The reset has a state that would not reach the environment.
        """
        frame = sys._getframe(1)
        while frame.f_code.co_name == "_supports_set_state" and frame.f_back:
            frame = frame.f_back
        if frame.f_code is not _RESOLVE_CODE:
            return True
        names = "self", "set_state", "tensordict", "select_reset_only"
        env, set_state, entries, only_mask = (frame.f_locals[name] for name in names)
        if set_state is False or only_mask:
            return True  # torchrl ignores the state
        if not isinstance(env, (TransformedEnv, SerialEnv, ParallelEnv)):
            return True
        has_nested = has_nested_state(entries)
        arrives = has_nested and NESTED_STATE in set(env.state_spec.keys())
        if isinstance(env, SerialEnv):
            # A SerialEnv passes all entries on, so its environments check them.
            return bool(set_state or arrives)
        keys = set() if entries is None else set(entries.keys())
        has_state = has_nested or keys & set(BODY_KEYS) - self._observed
        if not arrives and (set_state or has_state):
            name = type(env).__name__
            raise ValueError(
                f"the state would not reach the environment, because torchrl's {name} "
                f"passes on only the entries that its state_spec names: add "
                "torch_panda.envs.StateTransform to the environment (of each worker), "
                f"and give the state under the key {NESTED_STATE!r}, as in "
                f"reset(TensorDict({{{NESTED_STATE!r}: state}}, env.batch_size), "
                "set_state=True)"
            )
        # Without a state, answer no: torchrl would take the ``step_count`` of a
        # `StepCounter` for a state.
        return arrives
