"""``python -m torch_panda bench``, in small."""

import json
from importlib.util import find_spec

import pytest

from torch_panda.__main__ import main
from torch_panda.bench import command, comparison
from torch_panda.bench.contenders import CONTENDERS, OURS
from torch_panda.bench.runner import ContenderError
from torch_panda.bullet.native import LIBRARY


def rows_of(output):
    lines = [line for line in output.splitlines() if line.startswith("| Panda")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def test_table_json_and_plot(tmp_path, capsys):
    path, picture = tmp_path / "bench.json", tmp_path / "bench.png"
    options = ["--ids", "PandaPush-v3", "PandaFlip-v1", "--num-envs", "1", "2"]
    options += ["--others", "fetch", "bare-bullet", "--rounds", "3", "--steps", "2"]
    main(
        [
            "bench",
            *options,
            "--num-threads",
            "2",
            "--json",
            str(path),
            "--plot",
            str(picture),
        ]
    )
    assert picture.read_bytes().startswith(b"\x89PNG")
    output = capsys.readouterr()
    rows = rows_of(output.out)
    settings = [tuple(row[:3]) for row in rows if row[3] == OURS]
    # No more threads than environments.
    assert settings == [
        (env_id, *numbers)
        for env_id in ("PandaPush-v3", "PandaFlip-v1")
        for numbers in (("1", "1"), ("2", "2"))
    ]
    assert all(row[5] == "1.00 (1.00 to 1.00)" for row in rows if row[3] == OURS)
    assert "Fetch has no task like PandaFlip-v1" in output.out
    assert "%" in output.err  # the progress bar

    document = json.loads(path.read_text())
    assert document["versions"]["pybullet"]
    entries = document["results"]
    assert len(entries) == len(rows)
    for entry in entries:
        assert len(entry["speeds"]) == len(entry["ratios"]) == 3
        # Each round is compared with torch_panda's: it comes first in its setting.
        if entry["contender"] == OURS:
            ours = entry
            assert 20 < ours["footprint"]["memory"] < 60  # [MB]
        for clock in ("per_second", "per_cpu_second"):
            rounds = zip(ours["speeds"], entry["speeds"], entry["ratios"], strict=True)
            for a, b, ratio in rounds:
                assert b[clock] > 0
                assert ratio[clock] == pytest.approx(a[clock] / b[clock])
    bare = [e for e in entries if e["contender"] == "bare-bullet"]
    measured = [] if LIBRARY is None else [1, 2, 1, 2]
    assert [e["setting"]["num_envs"] for e in bare] == measured


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (ContenderError("no memory"), r"^Setting\(.*num_envs=2.*\): no memory$"),
        (KeyboardInterrupt(), "^interrupted$"),
    ],
)
def test_what_was_measured_before_a_failure_is_kept(
    tmp_path, capsys, monkeypatch, error, message
):
    def compare(setting, *args, **options):
        if setting.num_envs > 1:
            raise error
        return comparison.compare(setting, *args, **options)

    monkeypatch.setattr(command, "compare", compare)
    path, picture = tmp_path / "bench.json", tmp_path / "bench.png"
    options = ["--ids", "PandaReach-v3", "--others", "--rounds", "1", "--steps", "1"]
    options += ["--json", str(path), "--plot", str(picture)]
    with pytest.raises(SystemExit, match=message):
        main(["bench", *options, "--num-envs", "1", "2", "3"])
    assert [row[:4] for row in rows_of(capsys.readouterr().out)] == [
        ["PandaReach-v3", "1", "1", OURS]
    ]
    assert len(json.loads(path.read_text())["results"]) == 1
    assert picture.exists()
    path.unlink()
    with pytest.raises(SystemExit, match=message):
        main(["bench", *options, "--num-envs", "2"])
    assert not capsys.readouterr().out
    assert not path.exists()


@pytest.mark.parametrize("name", list(CONTENDERS))
def test_every_contender_that_is_installed(name, capsys):
    missing = [module for module in CONTENDERS[name].needs if find_spec(module) is None]
    options = ["--num-envs", "2", "--rounds", "1", "--steps", "2"]
    options += ["--ids", "PandaReach-v3"]
    main(["bench", *options, "--others", *([name] if name != OURS else [])])
    output = capsys.readouterr().out
    if missing or (name == "bare-bullet" and LIBRARY is None):
        assert f"not measured: {CONTENDERS[name].title}" in output
    else:
        assert CONTENDERS[name].title in [row[3] for row in rows_of(output)]
        assert "not measured" not in output


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--ids", "PandaFly-v1"], "unknown environment id 'PandaFly-v1'"),
        (["--num-envs", "0"], "must be an integer from 1 on, got 0"),
        (["--num-envs", "4", "many"], "must be an integer from 1 on, got many"),
        (["--num-threads", "-1"], "must be an integer from 1 on, got -1"),
        (["--rounds", "0"], "must be an integer from 1 on, got 0"),
        (["--others", "mujoco"], "invalid choice: 'mujoco'"),
        (["--json", "no/such/folder.json"], "must be a file in a folder"),
        (["--plot", "no/such/folder.png"], "must be a file in a folder"),
    ],
)
def test_bad_options(options, message, capsys):
    with pytest.raises(SystemExit) as error:
        main(["bench", *options])
    assert error.value.code == 2
    assert message in capsys.readouterr().err


def test_without_a_progress_bar(monkeypatch):
    monkeypatch.setattr(command, "find_spec", lambda name: None)
    with pytest.raises(SystemExit, match=r"pip install 'torch_panda\[bench\]'"):
        main(["bench"])


def test_a_command_is_needed(capsys):
    with pytest.raises(SystemExit):
        main([])
    assert "bench" in capsys.readouterr().err
