"""The option --import: commands know the ids that a user's module registers."""

import sys

import pytest

import torch_panda
from tests.commands.runs import MODULE
from torch_panda import registry
from torch_panda.commands import main, plot
from torch_panda.learning.user_modules import import_modules


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The current folder: it holds a module of a user and nothing else."""
    (tmp_path / "near_task.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.delitem(sys.modules, "near_task", raising=False)
    # Forget the id after the test.
    known = dict(registry._REGISTRATIONS)
    monkeypatch.setattr(registry, "_REGISTRATIONS", known)
    return tmp_path


def test_a_module_is_imported_by_its_name(folder):
    import_modules(["near_task"])
    assert torch_panda.max_episode_steps("Near-v0") == 10


def test_a_missing_library_is_refused_with_its_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "gymnasium_robotics", None)
    with pytest.raises(ValueError, match="it comes with the extra 'fetch'"):
        import_modules(["gymnasium_robotics"])


@pytest.mark.usefixtures("quick")
def test_a_registered_task_is_trained_evaluated_watched_and_plotted(folder, capsys):
    module = "near_task.py"
    train = ["--total-steps", "40", "--no-video", "--out", "run"]
    main(["train", "--env-id", "Near-v0", "--import", module, *train])
    main(["evaluate", "run", "--episodes", "4", "--import", module])
    assert "success at the end" in capsys.readouterr().out
    watch = ["--policy", "run", "--num-envs", "1", "--out", "watch.gif"]
    main(["watch", "--import", module, *watch])
    main(["plot", "."])
    assert (folder / "watch.gif").stat().st_size
    assert (folder / "curves.png").stat().st_size


@pytest.mark.slow
def test_worker_processes_import_the_module(folder, capsys):
    bench = ["--num-envs", "1", "--rounds", "1", "--steps", "2", "--others", "fast"]
    main(["bench", "--ids", "Near-v0", "--import", "near_task.py", *bench])
    rows = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert any(
        row[:8] == ["|", "Near-v0", "|", "1", "|", "1", "|", "torch_panda"]
        for row in rows
    )


def test_several_modules_are_imported_in_turn(folder, capsys):
    (folder / "first.py").write_text("print('first')")
    (folder / "second.py").write_text("print('second')")
    modules = ["--import", "first.py", "--import", "second.py"]
    with pytest.raises(SystemExit, match=r"^no policy 'nothing'"):
        main(["evaluate", "nothing", *modules])
    assert capsys.readouterr().out.splitlines() == ["first", "second"]


@pytest.mark.parametrize("name", ["torch", "sys"])
def test_a_file_does_not_replace_a_loaded_module(folder, name):
    (folder / f"{name}.py").write_text(MODULE)
    loaded = sys.modules[name]
    with pytest.raises(SystemExit, match=f"another module named '{name}' is loaded"):
        main(["evaluate", "run", "--import", f"{name}.py"])
    assert sys.modules[name] is loaded
    assert "Near-v0" not in registry._REGISTRATIONS


def test_an_error_inside_the_module_is_shown(folder):
    (folder / "broken.py").write_text("import there_is_no_such_library")
    with pytest.raises(ModuleNotFoundError, match="there_is_no_such_library"):
        main(["evaluate", "run", "--import", "broken"])


def test_a_missing_extra_is_one_error_with_its_command(monkeypatch):
    for name in [name for name in sys.modules if name.startswith("torch_panda.c")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "tyro", None)
    message = r"tyro is not installed; it comes with the extra 'learning': "
    message += r"pip install -e '.*\[learning\]'"
    with pytest.raises(SystemExit, match=message):
        main(["plot", "."])


@pytest.mark.parametrize("arguments", [["~/runs"], ["runs", "--out=~/curves.png"]])
def test_a_tilde_is_the_home_folder(tmp_path, monkeypatch, arguments):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setattr(plot, "read_runs", lambda folders, metric: folders)
    drawn = []
    monkeypatch.setattr(plot, "plot_panels", lambda *args: drawn.extend(args))
    main(["plot", *arguments])
    folders, _, out = drawn
    assert tmp_path in (folders[0].parent, out.parent)
