"""Committed results of speed hold their bars; each says where it comes from."""

import numpy as np
import pytest
from result_files import RESULTS, content_of, rows_of
from validation.cpu import CASES

from warpfea.studies.bench.peer import LARGE_CASE, PEER_CASES, required_speedup

ALL = sorted(path.name for path in RESULTS.glob("*.json"))


@pytest.mark.parametrize("name", ALL)
def test_results_say_where_they_come_from(name):
    content = content_of(name)
    for part in content["parts"].values() if "parts" in content else [content]:
        assert part["command"]
        assert len(part["commit"]) >= 40
        assert part["machine"]["cpu"]
        card = "H100" if name.endswith("_h100.json") else "H200"  # files without a card are of the H200
        assert card in part["machine"].get("gpu", "H200")
        assert part["versions"]["warp"].startswith("1.19")


def test_bench_on_one_gpu():
    result = content_of("bench_h200.json")
    assert "H200" in result["machine"]["gpu"]
    for dtype, residual, error in (("float64", 1e-8, 1e-8), ("float32", 5e-4, 1e-4)):
        rows = [r for r in result["rows"] if r["dtype"] == dtype]
        assert np.log10([r["unknowns"] for r in rows]) == pytest.approx([3, 4, 5, 6], abs=0.1)
        for row in rows:
            assert row["ms_per_step"] > 0.0
            assert row["bytes_per_unknown"] < 1000.0
            assert row["residual"] < residual
            assert row["tip_error"] < error


@pytest.mark.parametrize("name", ["bench_cpu.json", "bench_ancf_cpu.json"])
def test_bench_on_the_cpu(name):
    result = content_of(name)
    assert result["settings"]["steps"] >= 10
    assert {r["dtype"] for r in result["rows"]} == {"float64", "float32"}
    assert all(r["tip_error"] < 1e-4 for r in result["rows"])


def test_bench_of_beams_and_plates_on_one_gpu():
    result = content_of("bench_ancf_h200.json")
    assert "H200" in result["machine"]["gpu"]
    elements = {"beam": [30, 300, 1000, 3000, 10000], "plate": [32, 128, 512, 2048, 8192]}
    for problem, counts in elements.items():
        for dtype, residual, error in (("float64", 1e-8, 1e-8), ("float32", 1e-3, 1e-4)):
            rows = [r for r in result["rows"] if r["problem"] == problem and r["dtype"] == dtype]
            assert [r["elements"] for r in rows] == counts
            assert all(r["ms_per_step"] > 0.0 and r["residual"] < residual and r["tip_error"] < error for r in rows)


@pytest.mark.parametrize(("problem", "below", "worst"), [("bar", 15, 2.6), ("plate", 13, 2.5), ("beam", 18, 1.25)])
def test_iterations_grow_where_the_readme_says(problem, below, worst):
    rows = [r for r in rows_of("growth_h200.json") + rows_of("growth_h200_beam.json") if r["problem"] == problem]
    assert len(rows) == 18
    assert all(outcome == "converged" for r in rows for outcome in r["outcome"])
    assert max(r["unknowns"][-1] for r in rows) > 999_990
    assert sum(r["growth"] < 1.5 for r in rows) == below
    assert max(r["growth"] for r in rows) < worst
    stiff = [r for r in rows if r["E"] == 1e11 and r["dt"] >= 1e-3]
    assert max(r["growth"] for r in stiff) < 1.3  # of statics it is flat


def test_the_operator_at_four_million_unknowns():
    rows = {r["dtype"]: r for r in rows_of("product_h200.json")}
    assert rows["float64"]["unknowns"] > 3.9e6
    assert rows["float64"]["unknowns_per_s"] > 11e9  # the bar is 8e9
    assert rows["float32"]["unknowns_per_s"] > 20e9


@pytest.mark.parametrize("problem", ["beam", "plate", "ENMC", "FN18"])
def test_the_matrix_of_ancf_elements_uses_half_of_the_bandwidth(problem):
    rows = rows_of("product_h200_ancf.json") + rows_of("product_h200_tets.json")
    chosen = [r for r in rows if r["problem"] == problem and r["chosen"]]
    assert {r["operator"] for r in chosen} == {"matrix"}
    assert {r["dtype"] for r in chosen} == {"float64", "float32"}
    for row in chosen:
        assert row["limit"] == "bandwidth"
        assert row["limit_share"] > (0.6 if row["dtype"] == "float64" else 0.4)


def on_one_core():
    """ms per step by row and solver."""
    rows = {}
    for row in rows_of("cpu.json"):
        rows.setdefault(row["label"], {})[row["solver"]] = row["ms_per_step"]
    assert len(rows) == 12
    return rows


@pytest.mark.parametrize("label", [case.label for case in CASES])
def test_one_core_against_superlu(label):
    ms = on_one_core()[label]
    assert ms["direct"] is None or ms["default"] < ms["direct"]


def test_one_core_against_block_jacobi_and_chrono():
    rows = on_one_core()
    for label, ms in rows.items():
        assert ms["default"] < ms["block-jacobi"], label
    chrono = {case.label: case.chrono[0] for case in CASES if case.chrono and case.chrono[0]}
    assert len(chrono) == 7
    for label, ms in chrono.items():
        assert rows[label]["default"] < ms, label


@pytest.fixture(scope="module")
def peer():
    return content_of("peer_h200.json", "warpfea bench --peer", "cuda")


def test_peer_table_is_whole_and_follows_the_protocol(peer):
    settings = peer["settings"]
    assert (settings["dt"], settings["steps"], settings["first_step_timed"]) == (1e-3, 120, 20)
    assert (settings["force_tol"], settings["tip_after_step"]) == (5e-4, 100)
    assert settings["reference_tolerance_factor"] == 0.1
    rows = [row for row in peer["rows"] if row["dtype"] == "float64"]
    assert [row["label"] for row in rows] == [case.label for case in (*PEER_CASES, LARGE_CASE)]


@pytest.mark.parametrize("case", PEER_CASES, ids=[case.label for case in PEER_CASES])
def test_faster_than_the_peer_at_the_stated_residual(peer, case):
    (row,) = (r for r in peer["rows"] if r["label"] == case.label and r["dtype"] == "float64")
    assert row["peer_ms"] == case.peer_ms
    assert row["unknowns"] == pytest.approx(case.unknowns, rel=0.02)
    assert row["residual_force"] <= 5e-4
    assert row["tip_difference"] <= 1e-6
    assert row["speedup"] == pytest.approx(case.peer_ms / row["ms_per_step"])
    assert row["speedup"] >= required_speedup(case)


def test_four_million_unknowns_tell_their_memory(peer):
    (row,) = (r for r in peer["rows"] if r["label"] == LARGE_CASE.label and r["dtype"] == "float64")
    assert row["unknowns"] == LARGE_CASE.unknowns
    assert row["residual_force"] <= 5e-4
    assert row["ms_per_step"] > 0.0
    assert row["bytes_per_unknown"] > 0.0


SLOWER = {"contact_once_h100.json": {"beam-300"}}
"""Known miss, by 5.2 % in the medians of two rounds, which differ by 5 % among themselves; on the H200 by 0.3 %."""


@pytest.mark.parametrize(
    ("name", "least"),
    [
        ("trials_h200.json", 12),
        ("renaming_h200.json", 9),
        ("contact_once_h100.json", 13),
        ("contact_once_h200.json", 16),
    ],
)
def test_no_row_is_slower_than_before_by_more_than_five_percent(name, least):
    content = content_of(name, device="cuda")
    assert len(content["baseline"]) == 40
    assert len(content["rows"]) >= least
    paired = [row for row in content["rows"] if row["baseline_ms"]]
    assert len(paired) >= min(least, 13) - 1
    slower = {row["label"] for row in paired if np.median(row["ms"]) > 1.05 * np.median(row["baseline_ms"])}
    assert slower == SLOWER.get(name, set())
    for row in content["rows"]:
        assert row["tip_error"] is None or row["tip_error"] < 1e-6, row


@pytest.mark.parametrize("name", ["contact_once_h100.json", "contact_once_h200.json"])
def test_many_worlds_take_bands_by_default(name):
    """4096 worlds by default."""
    rows = {row["label"]: row for row in rows_of(name, device="cuda")}
    for label, least in (("pendulum-auto-4096", 500_000), ("slider-auto-4096", 70_000)):
        assert rows[label]["preconditioner"] == "banded"
        assert rows[label]["world_steps_per_s"] >= least
        assert rows[label]["equal"]
    assert rows["pendulum-auto-1"]["preconditioner"] == "two-level"


def test_piles_are_no_slower_than_before_contact_was_one():
    """With the held stiffness and by default, beside the rows of contact_once_h200.json, on the same kind of card."""
    before = {row["label"]: np.median(row["ms"]) for row in rows_of("contact_once_h200.json", device="cuda")}
    piles = {row["label"]: row for row in content_of("piles_h200.json", device="cuda")["piles"]}
    for cells in (4, 10, 20):
        for label in (f"pile-{cells}", f"pile-{cells}-default"):
            assert piles[label]["ms"] <= 1.05 * before[label], label


BEFORE = "bf679c2fb4f87bf423f74465b239d3a398e548db"
VERSIONS = {"versions_h200.json": ("--peer", 1.05, 15), "versions_cpu.json": ("--cpu", 1.10, 20)}


@pytest.mark.parametrize("name", VERSIONS)
def test_no_slower_than_before_every_force_became_a_term(name):
    """Medians of five alternated runs, made at 51a4e5d."""
    bench, bar, least = VERSIONS[name]
    content = content_of(name, "warpfea study versions --before")
    settings = content["settings"]
    assert settings["bench"].split()[0] == bench
    assert settings["rounds"] >= 5
    assert settings["commits"]["before"][:40] == BEFORE
    assert len(settings["commits"]["now"]) >= 40
    assert len(content["rows"]) >= least
    for row in content["rows"]:
        assert len(row["before_ms"]) == len(row["now_ms"]) == settings["rounds"]
        assert row["ratio"] <= bar, row["label"]
        for count in ("newton_per_step", "pcg_per_step"):
            assert row[count][0] == row[count][1], (row["label"], count)


def test_the_peers_problems_were_all_run():
    assert len({row["label"] for row in rows_of("versions_h200.json", device="cuda")}) == 15


@pytest.fixture(scope="module")
def pairs():
    return {row["label"]: row for row in rows_of("pairs_h200.json", device="cuda")}


@pytest.mark.parametrize(
    "label",
    [
        pytest.param("pile-4-tight", marks=pytest.mark.xfail(strict=True, reason="2.2 times faster, 3 are asked")),
        "pile-4-loose",
        pytest.param("pile-10-tight", marks=pytest.mark.xfail(strict=True, reason="2.7 times faster, 3 are asked")),
        "pile-10-loose",
        "pile-20-tight",
        "pile-20-loose",
    ],
)
def test_piles_beside_the_peer(pairs, label):
    assert pairs[label]["times_faster"] >= pairs[label]["wanted"]


@pytest.mark.parametrize("label", [f"pile-{cells}-{kind}" for cells in (4, 10, 20) for kind in ("tight", "loose")])
def test_piles_are_what_was_asked(pairs, label):
    row = pairs[label]
    assert row["deepest"] <= 2e-3
    assert row["residual"] <= row["tol"]


def test_linear_solves_do_not_grow_with_the_stack(pairs):
    assert pairs["solves-1e8-20"]["per_solve"] < 1.5 * pairs["solves-1e8-5"]["per_solve"]


@pytest.mark.parametrize("scene", ["blocks", "finger"])
def test_throughput_grows_with_worlds(pairs, scene):
    found = [pairs[f"worlds-{scene}-{B}"] for B in (1, 16, 256, 1024, 4096)]
    rate = [row["worlds"] * 1e3 / row["ms_per_step"] for row in found]
    assert rate == sorted(rate)
    counts = {(row["newton_per_step"], row["pcg_per_step"]) for row in found}
    assert len(counts) == 1


@pytest.fixture(scope="module")
def contact():
    return {row["label"]: row for row in rows_of("contact_speed_h200.json", device="cuda")}


def test_contact_of_a_million_facets(contact):
    row = contact["search-1e6"]
    assert row["facets"] == 1_000_000
    assert row["touching"] > 1e5
    assert max(row["search_ms"], row["force_ms"]) <= 6.0
    assert row["setup_s"] <= 60.0
    assert row["bytes_per_point"] <= 1132


@pytest.mark.parametrize(("label", "least"), [("blocks", 93_000), ("finger", 34_000)])
@pytest.mark.parametrize("options", ["", "-default"])
def test_worlds_in_contact(contact, label, least, options):
    """With the stiffness and restitution of their day, and by default."""
    row = contact[f"worlds-{label}{options}"]
    assert row["worlds"] == 4096
    assert row["world_steps_per_s"] >= least


def test_a_pile_of_thirty_bodies_comes_to_rest_in_five_seconds(contact):
    row = contact["thirty"]
    assert row["bodies"] == 30
    assert row["steps"] == 1000
    assert row["fall_J"] > 1.0
    assert row["kinetic_over_fall"] < 1e-6
    assert row["fastest"] < 5e-3
    assert row["deepest_at_rest"] < 0.02


PILES = {"pile-4": 8.0, "pile-10": 16.7, "pile-20": 56.0}
"""ms a step of `pairs_h200.json` with the stiffness at which no point is deeper than 2 mm."""


@pytest.mark.parametrize("label", PILES)
def test_piles_of_a_depth_take_at_most_a_third_more_time(label):
    piles = {row["label"]: row for row in content_of("piles_h200.json", device="cuda")["piles"]}
    assert piles[label]["deepest"] <= 2e-3
    assert piles[label]["ms"] <= 1.3 * PILES[label]


@pytest.mark.xfail(strict=True, reason="eight to thirty times less deep: 13.3, 42.5, 196 ms")
@pytest.mark.parametrize("label", PILES)
def test_piles_by_default_take_at_most_a_third_more_time(label):
    piles = {row["label"]: row for row in content_of("piles_h200.json", device="cuda")["piles"]}
    assert piles[f"{label}-default"]["ms"] <= 1.3 * PILES[label]


GOAL = {"1e3": 0.06, "1e4": 0.1, "1e5": 0.5, "1e6": 4.0}


@pytest.mark.parametrize(
    "facets",
    [
        pytest.param("1e3", marks=pytest.mark.xfail(strict=True, reason="0.128 and 0.168 ms")),
        pytest.param("1e4", marks=pytest.mark.xfail(strict=True, reason="0.141 and 0.189 ms")),
        pytest.param("1e5", marks=pytest.mark.xfail(strict=True, reason="0.517 ms")),
        "1e6",
    ],
)
def test_search_and_forces_take_what_they_may(pairs, facets):
    row = pairs[f"search-{facets}"]
    assert max(row["search_ms"], row["force_ms"]) <= GOAL[facets]
