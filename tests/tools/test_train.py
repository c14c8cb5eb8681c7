"""Training as a whole: runs in, report and models out; labels from truth; one-line errors."""

from __future__ import annotations

import base64
import json
import re

import numpy as np
import pandas
import pytest
from click.testing import CliRunner

from fls_flow import model_files as files
from fls_flow.cli.train import train as command
from fls_flow.discriminants import linear, posterior
from fls_flow.errors import FlsFlowError, UserError
from fls_flow.tools.train import lessons
from fls_flow.tools.train_labels import follow, look_up, throughout
from fls_flow.tools.train_model import Settings, unit_of
from fls_flow.tools.train_samples import Labelling, gather
from fls_flow.tools.train_tables import find_runs, read_table

NAMES = ("area", "perimeter", "phi1")
STEP_NS = 500_000_000
CLASSES = ("diver", "seal", "dolphin")


@pytest.fixture
def write_run(tmp_path):
    """A run folder: three targets far apart, a track on each and one on nothing; divers differ in `area`."""

    def made(
        name="run",
        seed=0,
        pings=40,
        parquet=False,
        tables=("static", "temporal"),
        shift=6.0,
        class_column=False,
    ):
        rng = np.random.default_rng(seed)
        folder = tmp_path / name
        folder.mkdir(parents=True)
        tracks, truth, rows = [], [], []
        for k in range(pings):
            stamp = 10**18 + k * STEP_NS
            for n, what in enumerate(CLASSES):
                x, y = 20.0 + 0.2 * k, 12.0 * n
                truth.append([k, stamp, n, x, y, 0.4, 0.0, what, "sensor"])
                at = x + rng.normal(0, 0.3), y + rng.normal(0, 0.3)
                tracks.append([k, stamp, 10 + n, "confirmed", *at, 0, 0, 1, 0, 1, "", "", "sensor"])
                row = rng.normal(size=3) + np.array([shift * (n == 0), 0.0, 0.0])
                rows.append([k, stamp, 10 + n, *row, *([what] if class_column else [])])
            tracks.append([k, stamp, 99, "confirmed", 80.0, 50.0, 0, 0, 1, 0, 1, "", "", "sensor"])
            rows.append([k, stamp, 99, *rng.normal(size=3), *([""] if class_column else [])])
        keys = ["seq", "stamp_ns"]
        if not class_column:
            columns = [
                "track_id",
                "status",
                "x_m",
                "y_m",
                "vx_mps",
                "vy_mps",
                "var_x",
                "cov_xy",
                "var_y",
                "label",
                "probability",
                "frame",
            ]
            pandas.DataFrame(tracks, columns=[*keys, *columns]).to_csv(folder / "tracks.csv", index=False)
            columns = ["target_id", "x_m", "y_m", "vx_mps", "vy_mps", "class", "frame"]
            pandas.DataFrame(truth, columns=[*keys, *columns]).to_csv(folder / "truth.csv", index=False)
        for table in tables:
            names = [f"{one}.mean" if table == "temporal" else one for one in NAMES]
            kept = rows[:: 5 if table == "temporal" else 1]
            frame = pandas.DataFrame(
                kept, columns=[*keys, "track_id", *names, *(["class"] if class_column else [])]
            )
            if parquet:
                frame.to_parquet(folder / f"{table}.parquet", index=False)
            else:
                frame.to_csv(folder / f"{table}.csv", index=False)
        (folder / "run.json").write_text(
            json.dumps(
                {"graph": "g", "digest": f"d{seed}", "nodes": {"s": {"with": {"seed": seed, "pings": pings}}}}
            )
        )
        return folder

    return made


def run(*arguments):
    """The command's result; errors of ours are raised, as the real command line shows them."""
    found = CliRunner().invoke(command, [str(one) for one in arguments], standalone_mode=False)
    if found.exception is not None:
        raise found.exception
    return found


def document(*arguments):
    return json.loads(run(*arguments, "--json").stdout)["sets"]


def test_runs_become_report_pictures_and_models(write_run, tmp_path):
    for seed in range(4):
        write_run(f"runs/{seed}", seed)
    out = tmp_path / "out"
    found = document(
        tmp_path / "runs",
        "--out",
        out,
        "--group",
        "marine-life=seal,dol*",
        "--miss-cost",
        "10",
        "--repeats",
        "5",
    )
    assert set(found) == {"static", "temporal"}
    static = found["static"]
    assert static["classes"] == ["diver", "marine-life"]
    assert static["trained_on"] == {"diver": [80, 2], "marine-life": [160, 4]}
    assert static["held_out"] == {"diver": [80, 2], "marine-life": [160, 4]}
    assert static["forward"]["features"][0] == "area"
    assert static["anova"]["area"]["p"] < 1e-20
    assert static["plain"]["error"] < 0.02
    assert static["by_cost"]["confusion"][0][1] <= static["plain"]["confusion"][0][1]
    assert static["costs"] == {"positive": "diver", "miss": 10.0, "false_alarm": 1.0}
    pictures = sorted(one.name for one in out.glob("*.png"))
    kinds = ("class_errors", "errors", "roc", "scatter")
    assert pictures == sorted(f"{name}_{kind}.png" for name in ("static", "temporal") for kind in kinds)
    page = (out / "report.html").read_text()
    inside = [base64.b64decode(one) for one in re.findall(r'src="data:image/png;base64,([^"]+)"', page)]
    assert len(inside) == 8
    assert all(one.startswith(b"\x89PNG") for one in inside)
    assert not re.search(r'(src|href)="(?!data:)', page)  # nothing from elsewhere
    for words in ("tables 5.1", "tables 5.3", "tables 5.5", "figures 5.1", "figures 5.3", "figures 5.5"):
        assert words in page


def test_the_model_gives_the_labels_that_the_report_counts(write_run, tmp_path):
    train, test = [write_run(f"train/{n}", n, shift=2.0) for n in range(2)], write_run("test/2", 2, shift=2.0)
    out = tmp_path / "out"
    found = document(
        *train, "--test", test, "--out", out, "--group", "other=seal,dolphin", "--miss-cost", "4"
    )
    model = files.load(out / "static.json")
    table = read_table(test / "static.csv")
    known = table.track_id != 99
    values = table.values[known][:, [table.names.index(name) for name in model.feature_names]]
    chance = posterior(linear(model.gaussians, model.ridge).scores(model.scaling(values)))
    is_diver, called = table.track_id[known] == 10, chance[:, 0] * 4.0 > chance[:, 1]
    counted = [
        [(is_diver & called).sum(), (is_diver & ~called).sum()],
        [(~is_diver & called).sum(), (~is_diver & ~called).sum()],
    ]
    assert found["static"]["by_cost"]["confusion"] == np.array(counted).tolist()
    assert found["static"]["trained_on"]["diver"] == [80, 2]
    assert found["static"]["held_out"]["diver"] == [40, 1]


def test_several_classes_stay_and_the_positive_one_stands_against_the_rest(write_run, tmp_path):
    runs = [write_run(f"runs/{n}", n) for n in range(4)]
    found = document(*runs, "--out", tmp_path / "out", "--against-rest", "--repeats", "3")["static"]
    assert found["classes"] == ["diver", "dolphin", "seal"]
    assert found["sides"] == ["diver", "others"]
    assert found["plain"]["error"] < 0.02  # dolphins and seals differ in nothing
    assert np.array(found["plain"]["confusion"]).shape == (2, 2)
    assert files.load(tmp_path / "out" / "static.json").class_names == ("diver", "dolphin", "seal")


def test_the_same_command_gives_the_same_bytes(write_run, tmp_path):
    runs = [write_run(f"runs/{n}", n) for n in range(3)]
    for out in ("one", "other"):
        run(*runs, "--out", tmp_path / out, "--repeats", "3", "--no-progress")
    for file in (tmp_path / "one").iterdir():
        assert file.read_bytes() == (tmp_path / "other" / file.name).read_bytes(), file.name


def test_provenance_names_runs_seeds_and_settings_and_no_place(write_run, tmp_path):
    runs = [write_run(f"runs/{n}", n) for n in range(3)]
    run(*runs, "--out", tmp_path / "out", "--repeats", "3", "--seed", "7")
    model = files.load(tmp_path / "out" / "static.json")
    said = model.provenance
    assert said["runs"] == [{"graph": "g", "digest": f"d{n}", "seeds": {"s.seed": n}} for n in range(3)]
    assert said["split"] == {"by": "track", "seed": 7, "train_share": 0.5}
    assert said["versions"].keys() == {"fls-flow", "numpy"}
    assert len(said["tables_sha256"]) == 6
    assert str(tmp_path) not in (tmp_path / "out" / "static.json").read_text()


@pytest.mark.parametrize("parquet", [False, True])
def test_csv_and_parquet_with_a_column_class(write_run, tmp_path, parquet):
    runs = [write_run(f"{n}", n, parquet=parquet, class_column=True, tables=("features",)) for n in range(3)]
    suffix = "parquet" if parquet else "csv"
    paths = [one / f"features.{suffix}" for one in runs]
    found = document(*paths, "--out", tmp_path / "out", "--by-track", "--repeats", "3")["features"]
    assert found["classes"] == ["diver", "dolphin", "seal"]
    assert {n for _, n in found["trained_on"].values()} <= {1, 2}
    assert (tmp_path / "out" / "features.json").is_file()


def test_what_somebody_says_of_tracks_counts_before_the_truth(write_run, tmp_path):
    runs = [write_run(f"runs/{n}", n) for n in range(2)]
    for one in runs:
        (one / "labels.csv").write_text("track_id,class\n10,diver\n11, crab\n")
    samples = gather(find_runs(runs), Labelling())[0]["static"]
    assert samples.counts == {"crab": (80, 2), "diver": (80, 2)}
    assert samples.unlabelled == 160
    (runs[0] / "labels.csv").write_text("track_id,class\n10,diver\n10,crab\n")
    assert "labels.csv:3: track_id 10 stands twice" in message(*runs, "--out", tmp_path / "out")
    (runs[0] / "labels.csv").write_text("track_id,class\nten,diver\n")
    assert "labels.csv:2: track_id is 'ten'" in message(*runs, "--out", tmp_path / "out")


def test_csv_and_parquet_are_read_alike(write_run):
    one, other = write_run("a", 3), write_run("b", 3, parquet=True)
    first, second = read_table(one / "static.csv"), read_table(other / "static.parquet")
    assert first.names == second.names
    assert (first.values == second.values).all()
    assert (first.stamp_ns == second.stamp_ns).all()


def test_tracks_that_follow_nothing_are_left_out_or_clutter(write_run):
    runs = find_runs([write_run()])
    sets, _ = gather(runs, Labelling())
    assert sets["static"].classes == ("diver", "dolphin", "seal")
    assert sets["static"].unlabelled == 40
    sets, _ = gather(runs, Labelling(clutter="clutter"))
    assert sets["static"].counts["clutter"] == (40, 1)


def test_static_and_temporal_hold_out_the_same_targets(write_run):
    sets, _ = gather(find_runs([write_run(f"{n}", n) for n in range(5)]), Labelling())
    split = lessons(sets, None, Settings(seed=3))
    for side in ("train", "test"):
        groups = {tuple(np.unique(getattr(one, side).group).tolist()) for one in split.values()}
        assert len(groups) == 1


def test_tracks_of_one_target_are_never_parted(write_run):
    """A target that two tracks follow one after the other is one group."""
    folder = write_run(tables=("static",))
    for name in ("tracks.csv", "static.csv"):
        table = pandas.read_csv(folder / name)
        table.loc[(table.track_id == 10) & (table.seq >= 20), "track_id"] = 55
        table.to_csv(folder / name, index=False)
    samples = gather(find_runs([folder]), Labelling())[0]["static"]
    assert samples.counts["diver"] == (40, 1)


@pytest.fixture
def follow_rows(tmp_path):
    """What `follow` finds for track rows (k, id, x, y) and truth rows (k, id, x, y, class)."""

    def made(tracks, truth, **options):
        text = "".join(f"{k},{k},{n},{x},{y}\n" for k, n, x, y in tracks)
        (tmp_path / "tracks.csv").write_text("seq,stamp_ns,track_id,x_m,y_m\n" + text)
        text = "".join(f"{k},{k},{n},{x},{y},{what}\n" for k, n, x, y, what in truth)
        (tmp_path / "truth.csv").write_text("seq,stamp_ns,target_id,x_m,y_m,class\n" + text)
        return follow(
            tmp_path / "tracks.csv", tmp_path / "truth.csv", **{"gate_m": 5.0, "share": 0.5} | options
        )

    return made


def test_a_track_follows_what_is_near_it_most_of_the_time(follow_rows):
    truth = [(k, 1, 0.0, 0.0, "diver") for k in range(10)] + [(k, 2, 0.0, 20.0, "seal") for k in range(10)]
    tracks = [(k, 5, 0.0, 1.0 if k < 6 else 19.0) for k in range(10)]
    found = follow_rows(tracks, truth)
    assert found.target.tolist() == [1] * 6 + [-1] * 4
    assert found.word.tolist() == ["diver"] * 6 + [""] * 4
    assert not found.free.any()
    assert (follow_rows(tracks, truth, share=0.7).target == -1).all()


def test_where_two_targets_meet_the_nearer_one_counts(follow_rows):
    truth = [(k, 1, 0.0, 0.0, "diver") for k in range(4)] + [
        (k, 2, 0.0, 6.0 - 2 * k, "seal") for k in range(4)
    ]
    found = follow_rows([(k, 5, 0.0, 0.8) for k in range(4)], truth)
    assert found.target.tolist() == [1, 1, 1, 1]
    found = follow_rows([(k, 5, 0.0, 1.2) for k in range(4)], truth)
    assert found.target.tolist() == [1, 1, -1, 1]  # seal at 6, 4, 2, 0 and diver at 0


def test_targets_that_come_and_go_and_empty_files(follow_rows):
    truth = [(k, 1, 0.0, 0.0, "diver") for k in (0, 1, 2, 7, 8, 9)]
    found = follow_rows([(k, 5, 0.0, 0.0) for k in range(10)], truth)
    assert found.target.tolist() == [1, 1, 1, -1, -1, -1, -1, 1, 1, 1]
    assert (follow_rows([(0, 5, 0.0, 0.0)], []).target == -1).all()
    assert not follow_rows([], truth).target.size
    assert look_up(follow_rows([], truth), np.array([1]), np.array([5])).tolist() == [-1]


def test_a_description_is_of_the_target_that_was_followed_in_all_its_pings(follow_rows):
    truth = [(k, 1, 0.0, 0.0, "diver") for k in range(4, 30)]
    tracks = [(k, n, 0.0, 9.0 if n == 6 and k == 20 else 0.0) for k in range(30) for n in (5, 6)]
    found = follow_rows(tracks, truth)

    def whole(track, pings):
        at = look_up(found, np.array(pings), np.full(len(pings), track))
        return throughout(found, at, np.full(len(pings), track)).tolist()

    blocks = [3, 6, 9, 12, 15, 18, 21, 24]  # of three pings: 1-3, 4-6, ...
    assert whole(5, blocks) == [False] + [True] * 7
    assert whole(6, blocks) == [False] + [True] * 5 + [False, True]
    assert whole(5, [5, 8, 12, 15]) == [False, True, True, True]  # ping 3 had no target
    assert whole(5, [3, 4, 5, 6])[1:] == [True] * 3  # one ping each
    assert whole(5, [7]) == [True]
    assert whole(9, [7]) == [False]  # no such track


def test_rows_are_looked_up_by_ping_and_track(follow_rows, rng):
    tracks = [(k, n, 0.0, 0.0) for k in range(20) for n in range(5) if rng.random() < 0.7]
    found = follow_rows(tracks, [])
    for k in range(20):
        for n in range(5):
            at = look_up(found, np.array([k]), np.array([n]))[0]
            expected = (k, n, 0.0, 0.0) in tracks
            assert (at >= 0) == expected
            if expected:
                assert (found.stamp_ns[at], found.track_id[at]) == (k, n)


@pytest.fixture
def rng():
    return np.random.default_rng(20261122)


def test_units_follow_from_names():
    assert unit_of("area") == "cells"
    assert unit_of("area_m2.rate_variance") == "(m^2)^2"
    assert unit_of("major_axis_m.mean_rate") == "m per ping"
    assert unit_of("speed_mps.variance") == "(m/s)^2"
    assert unit_of("variance.mean") == "amplitude^2"
    assert unit_of("phi1.variance") == ""
    assert unit_of("my_feature") == ""


def message(*arguments):
    with pytest.raises((FlsFlowError, UserError)) as caught:
        run(*arguments)
    text = str(caught.value)
    assert "\n" not in text
    return text


def test_what_cannot_be_learned_from_is_refused_in_one_line(write_run, tmp_path):
    one = write_run("one", 0)
    out = ("--out", tmp_path / "out")
    assert "class 'diver' comes from 1 target; a split by track needs two" in message(one, *out)
    assert "--test" in message(one, *out)
    (tmp_path / "empty").mkdir()
    assert "holds no feature table" in message(tmp_path / "empty", *out)
    assert "it takes two classes" in message(one, write_run("two", 1), "--group", "all=*", *out)
    assert "is no class; there are diver, dolphin, seal" in message(
        one, tmp_path / "two", "--positive", "x", *out
    )
    assert "--only zz*" in message(one, tmp_path / "two", "--only", "zz*", *out)
    assert "--group diver" in message(one, "--group", "diver", *out)
    assert "--train-share is 1.5" in message(one, "--train-share", "1.5", *out)
    assert "--gate-m is -1.0" in message(one, "--gate-m", "-1", *out)
    (one / "truth.csv").rename(one / "hidden.txt")
    assert "no truth.csv lies beside it; name it with --truth" in message(one, *out)
    (one / "tracks.csv").unlink()
    assert "no tracks.csv lies beside it" in message(one, *out)
    assert not (tmp_path / "out").exists()


def test_a_broken_table_is_named_with_its_line(write_run, tmp_path):
    one = write_run("one", 0, tables=("static",))
    lines = (one / "static.csv").read_text().splitlines()
    lines[5] = lines[5].rsplit(",", 1)[0] + ",many"
    (one / "static.csv").write_text("\n".join(lines))
    assert f"{one / 'static.csv'}:6: phi1 is 'many'" in message(one, "--out", tmp_path / "out")
    (one / "static.csv").unlink()
    (one / "static.parquet").write_bytes(b"PAR1 not really")
    assert "is no Parquet file" in message(one, "--out", tmp_path / "out")


def test_tables_that_differ_and_frames_that_differ(write_run, tmp_path):
    one, two = write_run("one", 0, tables=("static",)), write_run("two", 1, tables=("static",))
    table = pandas.read_csv(two / "static.csv")
    table.rename(columns={"area": "area_m2"}).to_csv(two / "static.csv", index=False)
    assert "have different columns" in message(one, two, "--out", tmp_path / "out")
    table.to_csv(two / "static.csv", index=False)
    truth = pandas.read_csv(two / "truth.csv").assign(frame="ned")
    truth.to_csv(two / "truth.csv", index=False)
    assert "frame is 'sensor', that of" in message(one, two, "--out", tmp_path / "out")


def test_a_folder_with_something_in_it_is_left_alone(write_run, tmp_path):
    runs = [write_run(f"runs/{n}", n) for n in range(2)]
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine.txt").write_text("mine")
    assert "holds something" in message(*runs, "--out", tmp_path / "out")
    assert "is a file" in message(*runs, "--out", tmp_path / "out" / "mine.txt")
    assert [one.name for one in (tmp_path / "out").iterdir()] == ["mine.txt"]


def test_constant_and_unknown_features_are_left_out_and_told(write_run, tmp_path):
    runs = [write_run(f"runs/{n}", n, tables=("static",)) for n in range(2)]
    for one in runs:
        table = pandas.read_csv(one / "static.csv").assign(perimeter=3.0)
        table.loc[:3, "area"] = np.nan
        table.to_csv(one / "static.csv", index=False)
    found = document(*runs, "--out", tmp_path / "out", "--repeats", "2")["static"]
    assert "perimeter" not in found["anova"]
    assert any("constant, left out: perimeter" in note for note in found["notes"])
    assert any("is no number: 6" in note for note in found["notes"])


def test_the_number_of_features_is_bounded_by_the_vectors(write_run, tmp_path):
    runs = [write_run(f"runs/{n}", n, pings=1, tables=("static",)) for n in range(4)]
    found = document(*runs, "--out", tmp_path / "out", "--repeats", "2", "--group", "other=seal,dolphin")[
        "static"
    ]
    assert sum(n for n, _ in found["trained_on"].values()) == 6
    assert len(found["forward"]["features"]) <= 2
