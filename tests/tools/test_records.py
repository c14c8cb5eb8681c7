from __future__ import annotations

import json

import pytest

from fls_flow.errors import UserError
from fls_flow.tools.cell import Row
from fls_flow.tools.records import Records

ABOUT = {"graph": "g", "set": {"a.b": ["1", "2"]}, "use": ()}
ROWS = [Row(0, "ok", 0.5, {"gospa": 1.25, "nees": None}), Row(3, "failed", 0.1, error="no idea")]


def filled(folder):
    with Records(folder, ABOUT) as records:
        for row in ROWS:
            records.append(row)


def test_rows_come_back(tmp_path):
    filled(tmp_path / "s")
    with Records(tmp_path / "s", ABOUT) as records:
        assert records.rows == {0: ROWS[0], 3: ROWS[1]}


def test_the_last_row_of_a_cell_counts(tmp_path):
    filled(tmp_path)
    with Records(tmp_path, ABOUT) as records:
        records.append(Row(3, "ok", scores={"gospa": 2.0}))
    with Records(tmp_path, ABOUT) as records:
        assert records.rows[3].status == "ok"


@pytest.mark.parametrize("cut", [1, 20, 60])
def test_a_line_cut_short_is_dropped_and_the_next_stands_alone(tmp_path, cut):
    filled(tmp_path)
    path = tmp_path / "cells.jsonl"
    path.write_bytes(path.read_bytes()[:-cut])
    with Records(tmp_path, ABOUT) as records:
        assert list(records.rows) == [0]
        records.append(ROWS[1])
    assert [json.loads(line)["index"] for line in path.read_text().splitlines()] == [0, 3]


@pytest.mark.parametrize(
    "about", [{**ABOUT, "graph": "h"}, {**ABOUT, "set": {"a.b": ["1", "3"]}}, {"graph": "g"}]
)
def test_another_sweep_is_refused(tmp_path, about):
    filled(tmp_path)
    before = (tmp_path / "cells.jsonl").read_bytes()
    with pytest.raises(UserError, match="holds another sweep"):
        Records(tmp_path, about)
    assert (tmp_path / "cells.jsonl").read_bytes() == before
    with Records(tmp_path, ABOUT) as records:  # the refused one holds nothing
        assert len(records.rows) == 2


def test_two_at_a_time_are_refused(tmp_path):
    with Records(tmp_path, ABOUT), pytest.raises(UserError, match="another sweep is writing"):
        Records(tmp_path, ABOUT)


@pytest.mark.parametrize(
    "text", ["nonsense\n", '{"index":1}\n', "[]\n", '{"index":1,"status":"ok","more":2}\n']
)
def test_a_damaged_file_is_named_with_its_line(tmp_path, text):
    filled(tmp_path)
    with (tmp_path / "cells.jsonl").open("a") as file:
        file.write(text)
    with pytest.raises(UserError, match=r"cells\.jsonl:3: "):
        Records(tmp_path, ABOUT)


@pytest.mark.parametrize("text", ["", "nonsense", "[1]"])
def test_a_damaged_sweep_json_is_named(tmp_path, text):
    filled(tmp_path)
    (tmp_path / "sweep.json").write_text(text)
    with pytest.raises(UserError, match=r"sweep\.json: is no sweep's"):
        Records(tmp_path, ABOUT)


def test_cells_without_their_sweep_are_refused(tmp_path):
    filled(tmp_path)
    (tmp_path / "sweep.json").unlink()
    with pytest.raises(UserError, match=r"no sweep\.json"):
        Records(tmp_path, ABOUT)


def test_a_file_in_place_of_the_folder_is_told(tmp_path):
    (tmp_path / "s").touch()
    with pytest.raises(UserError, match="cannot be written"):
        Records(tmp_path / "s", ABOUT)
