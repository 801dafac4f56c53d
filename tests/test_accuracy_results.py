"""The committed studies of error against run time: whole, of the schemes' orders, and as tests/README.md tells them."""

import json
import math
import pathlib

import pytest

RESULTS = pathlib.Path(__file__).parent / "results" / "studies"
SCHEMES = {"backward_euler": 1.0, "bdf2": 2.0, "energy_momentum": 2.0, "generalized_alpha(rho_inf=0.8)": 2.0}
"""With their orders."""
ORDERS = (
    "exact_cantilever_damped",
    "plate_vibration",
    "rigid_double_pendulum_time",
    "rigid_slider_crank_time",
    "spectral_pendulum_time",
)
"""Studies whose motion is smooth, and whose reference has the same model."""
LARGE = "large_soft_body_h200"
"""Such a one with 285 thousand unknowns, on an H200."""
OTHERS = ("rigid_double_pendulum", "rigid_slider_crank", "exact_cantilever", "spectral_pendulum", "bouncing_ball")
FAILED = {("rigid_slider_crank", "energy_momentum"), ("rigid_slider_crank_time", "energy_momentum")}
"""Cases without the larger steps: bars of 2e13 Pa, whose strains are rounding, at dead points."""


def result(name):
    return json.loads((RESULTS / f"{name}.json").read_text())


def fixed(content, scheme):
    """Rows of a scheme with fixed steps that were done, the largest first."""
    rows = [r for r in content["rows"] if r["setting"]["method"] == scheme and r["setting"]["dt"] is not None]
    return sorted((r for r in rows if r["status"] == "done"), key=lambda r: -r["setting"]["dt"])


def convergence_order(rows):
    """Over the three smallest steps: at the coarse end fast modes are not resolved yet."""
    a, b = rows[-3], rows[-1]
    return math.log(a["l2"] / b["l2"]) / math.log(a["setting"]["dt"] / b["setting"]["dt"])


@pytest.mark.parametrize("name", [*ORDERS, *OTHERS, LARGE])
def test_results_are_whole(name):
    content = result(name)
    assert content["command"].startswith("warpfea study ")
    assert not content["commit"].endswith("+")
    assert content["machine"]["cpu"]
    assert {row["setting"]["method"] for row in content["rows"]} == set(SCHEMES)
    for row in content["rows"]:
        method, adaptive = row["setting"]["method"], row["setting"]["error"] is not None
        if adaptive and method not in ("backward_euler", "bdf2"):
            assert row["status"] == "refused"
            assert "no estimate of its error" in row["why"]
        elif (name, method) not in FAILED:
            assert row["status"] == "done", row["why"]
    assert content["answer"] is not None
    assert len((RESULTS / f"{name}.csv").read_text().splitlines()) == len(content["rows"]) + 1
    for suffix in ("csv", "json", "png"):
        assert 1000 < (RESULTS / f"{name}.{suffix}").stat().st_size < 200_000


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("name", [*ORDERS, LARGE])
def test_results_have_the_orders_of_the_schemes(name, scheme):
    rows = fixed(result(name), scheme)
    assert len(rows) >= (3 if (name, scheme) in FAILED or name == LARGE else 4)
    assert all(r["resolved"] for r in rows)
    assert convergence_order(rows) == pytest.approx(SCHEMES[scheme], abs=0.1)


@pytest.mark.parametrize("name", ["exact_cantilever", "exact_cantilever_damped", "spectral_pendulum"])
def test_at_an_error_of_1e_4_the_second_order_is_at_least_ten_times_cheaper(name):
    """Backward Euler would not come to 1e-4 in ten times what the answer takes, in time and in iterations of PCG."""
    content = result(name)
    answer = content["rows"][content["answer"]["row"]]
    assert SCHEMES[answer["setting"]["method"]] == 2.0
    assert answer["error"] + answer["own_error"] <= content["target"] == 1e-4
    euler = fixed(content, "backward_euler")
    assert min(r["error"] for r in euler) > 2e-4
    for cost in ("seconds", "pcg"):  # at order 1, or less, the cost to 1e-4 is at least error x cost / 1e-4
        assert min(r["error"] * r[cost] for r in euler) > 10.0 * 1e-4 * answer[cost]


@pytest.mark.parametrize("name", [*ORDERS, *OTHERS, LARGE])
def test_targets_hold_with_other_steps(name):
    """The answer with 0.9 and 1.1 times its step, as near as whole steps come to the end."""
    content = result(name)
    answer = content["rows"][content["answer"]["row"]]
    which = "dt" if answer["setting"]["error"] is None else "error"
    ratios = [row["setting"][which] / answer["setting"][which] for row in content["checks"]]
    assert ratios == pytest.approx([0.9, 1.1], abs=0.02)
    for row in content["checks"]:
        assert row["status"] == "done"
        assert row["setting"]["method"] == answer["setting"]["method"]
        assert 0.0 < row["error"] < 1.5 * content["target"]


def table_of(name):
    """Cells of a marked table of tests/README.md."""
    text = (RESULTS.parents[1] / "README.md").read_text()
    lines = text.split(f"<!-- {name} -->")[1].split(f"<!-- /{name} -->")[0].strip().splitlines()[2:]
    return [line.strip("| ").split(" | ") for line in lines]


def test_numbers_of_the_table():
    """tests/README.md tells what the files hold."""
    lines = table_of("study-numbers")
    assert [line[0].split(",")[0].strip("`") for line in lines] == [*ORDERS, *OTHERS]
    for what, *told, target, cheapest, _ in lines:
        name = what.split(",")[0].strip("`")
        content = result(name)
        assert f"{content['target']:g}" == target
        assert cheapest == cheapest_text(content)
        assert told == [order_text(content, scheme) for scheme in SCHEMES]


def cheapest_text(content):
    row = content["rows"][content["answer"]["row"]]
    given = [row["setting"]["method"]]
    given += [f"{k}={row['swept'][k]:g}" for k in content["over"] if k != "method" and row["swept"][k] is not None]
    return f"{', '.join(given)}: {row['seconds']:.2g} s"


def order_text(content, scheme):
    """Order over the three smallest steps, or - where the reference does not resolve them, or steps were refused."""
    rows = fixed(content, scheme)
    return f"{convergence_order(rows):.2f}" if len(rows) > 2 and all(r["resolved"] for r in rows[-3:]) else "-"


def test_winners_of_the_table():
    """tests/README.md names the cheapest scheme for 1e-2, 1e-3 and 1e-4 of each study."""
    lines = table_of("winners")
    assert [line[0].strip("`") for line in lines] == [*ORDERS, *OTHERS]
    for name, *told in lines:
        content = result(name.strip("`"))
        assert told == [winner_text(content, target) for target in (1e-2, 1e-3, 1e-4)]


def winner_text(content, target):
    good = [r for r in content["rows"] if r["status"] == "done" and r["error"] + r["own_error"] <= target]
    if not good:
        return "-"
    best = min(good, key=lambda r: r["seconds"])
    adaptive = " adaptive" if best["setting"]["error"] else ""
    return f"{best['setting']['method'].partition('(')[0]}{adaptive}, {best['seconds']:.2g} s"


def test_every_integrator_runs_the_contact_scenes():
    """And tests/README.md tells their orders and what they dissipate."""
    content = json.loads((RESULTS.parent / "contact_integrators_cpu.json").read_text())
    lines = table_of("contact-integrators")
    told = iter(lines)
    assert len(lines) == 20
    for name in content["settings"]:
        for scheme in SCHEMES:
            rows = [r for r in content["rows"] if (r["scene"], r["method"]) == (name, scheme)]
            assert [r["dt"] for r in rows] == pytest.approx([content["settings"][name]["dt"] / 2**k for k in range(3)])
            assert all(r["status"] == "done" and abs(r["ledger_residual"]) < 1e-5 for r in rows)
            assert next(told) == contact_text(rows)


def contact_text(rows):
    last = rows[-1]
    clear = last["error"] > 3.0 * last["own_error"]
    order = f"{math.log(rows[0]['error'] / last['error'], 4.0):.1f}" if clear else "-"
    terms = (f"{last[term]:.1g}" for term in ("integrator", "contact_loss", "friction"))
    return [last["scene"], last["method"].partition("(")[0], f"{last['error']:.1g}", order, *terms]


def test_rounding_of_float32_is_told():
    """The error at which float32 stops, of each family."""
    rows = json.loads((RESULTS.parent / "precision_cpu.json").read_text())["rows"]
    lines = table_of("precision")
    assert [line[0] for line in lines] == list(dict.fromkeys(r["family"] for r in rows))
    for line in lines:
        own = [r for r in rows if r["family"] == line[0]]
        assert all(r["status"] == "done" for r in own)
        assert line[1:] == precision_text(own)


def precision_text(rows):
    return [f"{rows[-1][k]:.1e}" for k in ("float64", "float32")] + [f"{min(r['float32'] for r in rows):.1e}"]
