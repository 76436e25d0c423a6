"""If the solver does not fit the process, Bullet's own functions run."""

import platform
import sys

import pytest

from tests.solver.solvers import needs_packed
from torch_panda.bullet import library
from torch_panda.bullet.solver import SOLVER_VARIABLE, compat, native, self_test

pytestmark = needs_packed


@pytest.fixture
def closed(monkeypatch):
    """Pretend that nothing was replaced yet, and forbid to enable the replacement."""
    solver = compat.load_library()
    solver.uninstall()
    replacements = compat.find_replacements(library.library_path())
    monkeypatch.delenv(SOLVER_VARIABLE, raising=False)
    monkeypatch.setattr(compat, "_status", None)
    monkeypatch.setattr(
        native.SolverLibrary,
        "enable",
        lambda self, on: pytest.fail("the solver was enabled"),
    )
    yield
    monkeypatch.undo()
    # Bullet's functions are back in their slots.
    assert compat.find_replacements(library.library_path()) == replacements
    solver.install(replacements)


def reason():
    status = compat.activate()
    assert status.name == "bullet"
    assert str(status) == f"bullet: {status.reason}"
    return status.reason


def test_the_variable_switches_the_packed_solver_off(closed, monkeypatch):
    monkeypatch.setenv(SOLVER_VARIABLE, "bullet")
    assert reason() == "TORCH_PANDA_SOLVER=bullet"


def test_an_unknown_solver_is_refused(closed, monkeypatch):
    monkeypatch.setenv(SOLVER_VARIABLE, "fast")
    with pytest.raises(ValueError, match='must be "packed" or "bullet", got "fast"'):
        compat.activate()


def test_a_demanded_packed_solver_that_cannot_run_is_an_error(closed, monkeypatch):
    monkeypatch.setenv(SOLVER_VARIABLE, "packed")
    monkeypatch.setattr(platform, "machine", lambda: "aarch64")
    with pytest.raises(
        RuntimeError, match="=packed, but the packed solver needs x86-64 Linux"
    ):
        compat.activate()


@pytest.mark.parametrize(
    ("system", "machine"),
    [("linux", "aarch64"), ("darwin", "x86_64"), ("win32", "AMD64")],
)
def test_the_solver_stays_off_on_another_platform(closed, monkeypatch, system, machine):
    monkeypatch.setattr(sys, "platform", system)
    monkeypatch.setattr(platform, "machine", lambda: machine)
    assert f"this is {system} on {machine}" in reason()


def test_an_empty_variable_counts_as_unset(closed, monkeypatch):
    monkeypatch.setenv(SOLVER_VARIABLE, "")
    monkeypatch.setattr(platform, "machine", lambda: "aarch64")
    assert "needs x86-64 Linux" in reason()


def test_the_solver_stays_off_for_another_version_of_pybullet(closed, monkeypatch):
    monkeypatch.setattr(library, "SUPPORTED_VERSION", "3.2.6")
    assert reason() == "the packed solver needs pybullet 3.2.6, and 3.2.7 is installed"


def test_the_solver_stays_off_without_a_compiled_library(closed, monkeypatch):
    monkeypatch.setattr(compat, "_LIBRARY", compat._LIBRARY.with_name("missing.so"))
    assert "the packed solver is not compiled" in reason()


@pytest.mark.parametrize("part", [0, 1])
def test_the_solver_stays_off_if_a_symbol_is_missing(closed, monkeypatch, part):
    replaced = [list(names) for names in compat._REPLACED]
    replaced[0][part] = "_ZTV7missing"
    monkeypatch.setattr(compat, "_REPLACED", replaced)
    assert reason() == "pybullet has no symbol _ZTV7missing"


def test_the_solver_stays_off_for_a_stripped_module(closed, monkeypatch, tmp_path):
    stripped = tmp_path / "pybullet.so"
    header = bytearray(64)
    header[:6] = b"\x7fELF\x02\x01"
    stripped.write_bytes(header)
    monkeypatch.setattr(library, "library_path", lambda: str(stripped))
    assert "has no .symtab" in reason()


def test_the_solver_stays_off_for_a_module_that_is_no_elf_file(closed, monkeypatch):
    monkeypatch.setattr(library, "library_path", lambda: __file__)
    assert "is not a 64-bit ELF file" in reason()


def test_the_solver_stays_off_if_a_table_lacks_its_function(closed, monkeypatch):
    (table, _), *others = compat._REPLACED
    replaced = [(table, others[1][1]), *others]
    monkeypatch.setattr(compat, "_REPLACED", replaced)
    assert "holds the function to replace 0 times" in reason()


@pytest.mark.parametrize(
    ("field", "value", "wrong"),
    [  # one for each part of the probe
        ("num_iterations", 50, "m_numIterations"),
        ("masses", (0.3, 0.3), "btMultiBody.m_baseMass"),
        ("gravity", -9.8, "btMultibodyLink.m_appliedForce"),
        ("table_size", 0.4, "btBroadphaseProxy.m_aabbMax"),
        ("ik_iterations", 7, "m_maxNumIterations"),
    ],
)
def test_the_solver_stays_off_if_bullets_layout_differs(
    closed, monkeypatch, field, value, wrong
):
    # Expect wrong numbers of the scene: the probe then reports a field, as it would if
    # the field were at another offset.
    probe = native.SolverLibrary.set_mode

    def set_mode(self, mode, expectation=None):
        if expectation is not None:
            setattr(expectation, field, value)
        probe(self, mode, expectation)

    monkeypatch.setattr(native.SolverLibrary, "set_mode", set_mode)
    assert reason().startswith("Bullet's layout differs: ")
    assert wrong in reason()


def test_an_interrupted_self_test_puts_bullets_functions_back(closed, monkeypatch):
    def interrupt(*args, **tables):
        raise KeyboardInterrupt

    monkeypatch.setattr(compat, "run_self_test", interrupt)
    with pytest.raises(KeyboardInterrupt):
        compat.activate()
    assert compat.find_replacements(library.library_path())


def test_the_solver_stays_off_for_a_library_of_other_sources(closed, monkeypatch):
    monkeypatch.setattr(native, "VERSION", 0)
    assert "but the sources of torch_panda have version 0" in reason()


def test_the_solver_stays_off_if_results_differ(closed, monkeypatch):
    simulate = self_test._simulate
    runs = []

    def differ():
        states = simulate()
        runs.append(states)
        if len(runs) == 2:
            states[7] = states[7][:-1] + bytes([states[7][-1] ^ 1])
        return states

    monkeypatch.setattr(self_test, "_simulate", differ)
    assert reason() == "the self-test differs from Bullet in step 7"


def test_the_solver_stays_off_if_groups_are_left_to_bullet(closed, monkeypatch):
    monkeypatch.setattr(self_test, "SOLVE", native.LEAVE)
    assert reason() == "the packed solver did not solve all groups of the self-test"


@pytest.mark.parametrize(
    ("field", "wrong"),
    [
        ("manifolds", "did not create the rows of the self-test"),
        ("bodies", "did not compute the accelerations of the self-test"),
        ("aabbs", "did not move the AABBs of the self-test"),
        ("answers", "did not compute the inverse kinematics of the self-test"),
    ],
)
def test_the_solver_stays_off_if_a_part_is_left_to_bullet(
    closed, monkeypatch, field, wrong
):
    counts = native.SolverLibrary.counts

    def without_field(self):
        result = counts(self)
        setattr(result, field, 0)
        return result

    monkeypatch.setattr(native.SolverLibrary, "counts", without_field)
    assert reason() == f"the packed solver {wrong}"


def test_compatibility_is_decided_once(monkeypatch):
    monkeypatch.setattr(
        compat, "enable_if_compatible", lambda: pytest.fail("decided again")
    )
    monkeypatch.setenv(SOLVER_VARIABLE, "bullet")
    assert compat.activate().name == "packed"
