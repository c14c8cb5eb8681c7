"""The private folder in which the runs of a user meet."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from fls_flow import local_runs


@pytest.fixture
def base(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    return tmp_path / "fls-flow"


def test_what_a_run_that_was_killed_has_left_is_removed_by_the_next(base):
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    for name, text in (("dead", dead.pid), ("alive", os.getpid()), ("odd", "{"), ("empty", "")):
        (base / name).mkdir(parents=True)
        (base / name / "the.pid").write_text(str(text))
    base.chmod(0o700)
    (base / "young").mkdir()  # its run has made it and not announced itself yet
    with local_runs.meeting_place("mine", ["hub"]) as place:
        assert sorted(path.name for path in base.iterdir()) == ["alive", "empty", "mine", "odd", "young"]
        assert place == base / "mine"
        assert (place / "the.pid").read_text() == str(os.getpid()), "killed now, the next one removes it"
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


def test_a_folder_without_room_is_passed_over_and_left_as_it_was(tmp_path):
    code = (
        "import resource, sys\n"
        "from fls_flow import local_runs\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))\n"  # as little room as on a full disk
        "try:\n"
        "    with local_runs.meeting_place('mine', ['hub']):\n"
        "        pass\n"
        "except local_runs.RunError as error:\n"
        "    sys.exit(str(error))\n"
    )
    places = {"XDG_RUNTIME_DIR": str(tmp_path / "own"), "TMPDIR": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, **places},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    bases = [tmp_path / "own" / "fls-flow", tmp_path / f"fls-flow-{os.getuid()}"]
    assert line.startswith("; ".join(f"{base}: cannot be used: File too large" for base in bases))
    assert [list(base.iterdir()) for base in bases] == [[], []]
