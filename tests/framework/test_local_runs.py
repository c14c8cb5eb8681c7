"""The private folder in which the runs of a user meet."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest

from fls_flow import local_runs


@pytest.fixture
def base(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    return tmp_path / "fls-flow"


def of(pid: int) -> str:
    about = {"run": "r", "graph": "g", "host": "h", "endpoint": "e", "pid": pid}
    return json.dumps(about)


def test_what_a_run_that_was_killed_has_left_is_removed_by_the_next(base):
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    for name, text in (("dead", of(dead.pid)), ("alive", of(os.getpid())), ("odd", "{"), ("empty", "{}")):
        (base / name).mkdir(parents=True)
        (base / name / "run.json").write_text(text)
    base.chmod(0o700)
    (base / "young").mkdir()  # its run has made it and not announced itself yet
    with local_runs.meeting_place("mine", ["hub"]) as place:
        assert sorted(path.name for path in base.iterdir()) == ["alive", "empty", "mine", "odd", "young"]
        assert place == base / "mine"
    assert not (base / "mine").exists()


def test_a_folder_that_others_may_enter_is_refused(base):
    base.mkdir(mode=0o755)
    base.chmod(0o755)
    with pytest.raises(local_runs.RunError, match="not a private folder"), local_runs.meeting_place("r", []):
        raise AssertionError("never entered")


@pytest.mark.parametrize("given", ["/proc", "not/absolute"])
def test_where_nothing_can_be_made_the_temporary_folder_serves(tmp_path, monkeypatch, given):
    monkeypatch.setenv("XDG_RUNTIME_DIR", given)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with local_runs.meeting_place("mine", ["hub"]) as place:
        assert place == tmp_path / f"fls-flow-{os.getuid()}" / "mine"
        assert place.is_dir()
    assert [path.name for path in tmp_path.iterdir()] == [f"fls-flow-{os.getuid()}"]


def test_where_no_folder_can_be_used_each_is_named(monkeypatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", "/proc")
    monkeypatch.setattr("tempfile.tempdir", "/proc/self")
    with pytest.raises(local_runs.RunError) as raised, local_runs.meeting_place("mine", ["hub"]):
        raise AssertionError("never entered")
    assert "/proc/fls-flow: cannot be used" in str(raised.value)
    assert "/proc/self/fls-flow-" in str(raised.value)
    assert "set XDG_RUNTIME_DIR to a folder of your own" in str(raised.value)
