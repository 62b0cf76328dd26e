"""The command `fit`: from the lines of a file to the table and the figure."""

import errno

import numpy as np
import pandas as pd
import pytest
from matplotlib.image import imread

from viapoint.primitives import fit_via_points, through
from viapoint.training.cli import entry as cli

WAYPOINTS = {
    "around": [[0.0, 0.3, 0.1], [0.12, 0.45, 0.1], [0.3, 0.3, 0.2]],
    "straight": [[0.0, 0.3, 0.1], [0.3, 0.35, 0.1]],
}


def recorded(*columns):
    """Table of two movements with little noise, which begin and end within the recording."""
    rng, parts = np.random.default_rng(0), []
    for name, waypoints in WAYPOINTS.items():
        trajectory = through(waypoints, [0.5] * (len(waypoints) - 1))
        time = np.arange(-0.1, float(trajectory.duration) + 0.1, 0.01)
        position = trajectory(time) + rng.normal(0.0, 2e-4, (len(time), 3))
        part = pd.DataFrame({"time": time, **dict(zip("xyz", position.T, strict=True)), "movement": name})
        parts.append(part[list(columns)])
    return pd.concat(parts) if "movement" in columns else parts[0]


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "movements.csv"
    recorded("movement", "time", "x", "y", "z").to_csv(path, index=False)
    return path


def run(*words):
    cli.main(["fit", *map(str, words)])


def test_a_file_gives_a_table_and_a_figure(file, tmp_path, capsys):
    folder = tmp_path / "new" / "fit"
    run(file, "--out", folder)
    printed = capsys.readouterr().out
    table = pd.read_csv(folder / "fit.csv")
    assert list(table["movement"]) == list(WAYPOINTS)
    assert list(table["n_via"]) == [1, 0]
    assert all(name in printed for name in WAYPOINTS)
    around = table.iloc[0]
    np.testing.assert_allclose(
        around[["via1_x", "via1_y", "via1_z"]].astype(float), WAYPOINTS["around"][1], atol=5e-3
    )
    np.testing.assert_allclose(around[["duration", "via1_time"]].astype(float), [1.0, 0.5], atol=0.02)
    assert table["via1_x"].isna().tolist() == [False, True]
    assert np.ptp(imread(folder / "fit.png")) > 0.5
    run(file, "--out", folder, "--n-via", 0, 2)  # a folder of the command is written again
    pd.testing.assert_frame_equal(pd.read_csv(folder / "fit.csv"), table)


def test_a_plane_movement_needs_no_other_columns_and_is_that_of_the_function(tmp_path):
    path, table = tmp_path / "one.csv", recorded("time", "x", "y")
    table.to_csv(path, index=False)
    run(path, "--out", tmp_path, "--n-via", 1, "--no-free-ends")
    fit = fit_via_points(table["time"].to_numpy(), table[["x", "y"]].to_numpy(), 1, free_ends=False)
    written = pd.read_csv(tmp_path / "fit.csv").iloc[0]
    np.testing.assert_allclose(written[["via1_x", "via1_y"]].astype(float), fit.via_points[0], atol=1e-9)
    assert "via1_z" not in written


@pytest.mark.parametrize("column", ["time", "x"])
def test_other_units_than_seconds_and_metres_are_told(column, tmp_path, capsys):
    table = recorded("time", "x", "y")
    table[column] *= 1000.0
    table.to_csv(tmp_path / "one.csv", index=False)
    run(tmp_path / "one.csv", "--out", tmp_path, "--n-via", 1)
    assert ("seconds" if column == "time" else "metres") in capsys.readouterr().err


def test_the_most_via_points_are_told(tmp_path, capsys):
    recorded("time", "x", "y").to_csv(tmp_path / "one.csv", index=False)
    run(tmp_path / "one.csv", "--out", tmp_path, "--n-via", 0, 1)
    assert "the most allowed" in capsys.readouterr().err
    run(tmp_path / "one.csv", "--out", tmp_path, "--n-via", 0, 2)
    assert capsys.readouterr().err == ""


TABLE = ["time,x,y", "0.0,0.1,0.2", "0.1,0.1,0.2", "0.2,0.1,0.2"]


@pytest.mark.parametrize(
    ("lines", "told"),
    [
        ([TABLE[0], *(f"{line},0.3" for line in TABLE[1:])], "Expected 3 fields in line 2, saw 4"),
        ([TABLE[0], *(f"{line}," for line in TABLE[1:])], "Expected 3 fields in line 2, saw 4"),
        ([*TABLE[:3], "", "  ", "0.2,0.1"], "line 6, column y: nothing"),
        ([*TABLE[:2], "", "0.1,far,0.2"], "line 4, column x: far"),
        (["y", "0.1"], "no column time"),
        (["time;x;y", "0.0;0.1;0.2"], "separate columns by commas"),
        ([TABLE[0], *(f"{-time},0.1,0.2" for time in range(12))], "goes back in time in line 3"),
        ([*TABLE, *TABLE[1:]], "add a column `movement`"),
        (["time,x,y", "s,m,m", *TABLE[1:]], "leave out lines of units"),
        (["# arm 1", *TABLE], "first line must name the columns"),
        (TABLE[:1], "holds no samples"),
        (["", *TABLE[:3], "0.1,,0.2"], "line 5, column x: nothing"),
        (["time,x,y,x", "0.0,0.1,0.2,0.1"], "several columns x"),
        (["time,x,y,movement", "0.0,0.1,0.2,a", "", "0.1,0.1,0.2,"], "names no movement in line 4"),
        (["time,x,y,movement", "0.0,0.1,0.2,null"], "names no movement in line 2"),
    ],
)
def test_lines_at_fault_are_told_by_their_number_in_the_file(lines, told, tmp_path, failed):
    path = tmp_path / "lines.csv"
    path.write_text("\n".join(lines))
    assert told in failed("fit", path, "--out", tmp_path / "fit")
    assert not (tmp_path / "fit").exists()


def test_foreign_files_stay(file, tmp_path, failed):
    (tmp_path / "fit.csv").write_text("mine")
    assert "not written by viapoint" in failed("fit", file, "--out", tmp_path)
    assert (tmp_path / "fit.csv").read_text() == "mine"
    (tmp_path / "empty.csv").touch()
    assert "is empty" in failed("fit", tmp_path / "empty.csv", "--out", tmp_path / "fit")


def test_a_full_disk_leaves_no_half_of_a_figure(file, tmp_path, failed, monkeypatch):
    def full(handle):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    assert "fit.png" in failed("fit", file, "--out", tmp_path / "fit")
    assert not list((tmp_path / "fit").iterdir())
