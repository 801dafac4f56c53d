"""`warpfea bench --worlds`: its mesh and its rows; tests/results/worlds_h200.json, made by it."""

import json
import pathlib

import numpy as np
import pytest

from warpfea.cli import main
from warpfea.studies.bench.worlds import five_tets

FILE = pathlib.Path(__file__).resolve().parent / "results" / "worlds_h200.json"
SLOW = {"pendulum": 850_000, "slider": 200_000, "double": 100_000, "finger": 25_000, "tets": 1_638_400}


@pytest.mark.parametrize("cells", [(1, 1, 1), (3, 2, 2)])
def test_five_tets_fill_a_box_and_match(cells):
    found = five_tets((3.0, 2.0, 1.0), cells)
    edges = found.points[found.cells[:, 1:]] - found.points[found.cells[:, :1]]
    volumes = np.linalg.det(edges) / 6.0
    assert len(found.cells) == 5 * np.prod(cells)
    assert volumes.min() > 0.0
    assert volumes.sum() == pytest.approx(6.0)
    faces = np.sort(found.cells[:, [[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]]].reshape(-1, 3), axis=1)
    _, count = np.unique(faces, axis=0, return_counts=True)
    a, b, c = cells
    assert (count == 1).sum() == 4 * (a * b + b * c + a * c)  # two triangles on each face outside
    assert count.max() <= 2


def test_rows_are_made(tmp_path, capfd):
    out = tmp_path / "worlds.json"
    assert main(["bench", "--worlds", "--device", "cpu", "--rows", "tets-auto-1", "--dtype", "float64",
                 "--out", str(out)]) == 0  # fmt: skip
    (row,) = json.loads(out.read_text())["rows"]
    assert (row["worlds"], row["unknowns"]) == (1, 13 * 9 * 3 - 9 * 3)
    assert row["tip_error"] < 1e-5
    assert row["later_error"] < 1e-5
    assert "tets-auto-1" in capfd.readouterr().out
